"""The pages of the app, one function each, and what is around them."""
