"""The one exception that means "the user can mend this"."""


class InputError(ValueError):
    """A user's mistake: one line with what was wrong, what was expected, and the choices."""
