"""The exception of this package."""


class BadInput(ValueError):
    """Bad input: one clear line with its name, its value and the allowed values."""
