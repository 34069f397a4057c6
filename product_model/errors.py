"""The exception of this package."""


class BadInput(ValueError):
    """One clear line that names what is wrong, its value and what is allowed."""
