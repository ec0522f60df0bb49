"""Errors that are about what the user asked for, not about the program."""


class UserError(ValueError):
    """Something in the command or the configuration cannot be; the message says what, and what could be."""
