"""The exceptions that mean "the user can mend this"."""

from collections.abc import Mapping
from typing import Any, TypeVar

_Choice = TypeVar("_Choice")


class InputError(ValueError):
    """A user's mistake: one line with what was wrong, what was expected, and the choices."""


class DamageError(InputError):
    """A file is not what jbrep wrote; the message names it."""


def check_version(path: object, found: Any, known: int) -> None:
    """Make sure that a file's format isn't newer than the one known here.

    Raises:
        InputError: it is.
    """
    if not isinstance(found, int) or found > known:
        raise InputError(
            f"{path} has format version {found}: this jbrep reads up to {known}, so a newer one is "
            "needed"
        )


def choose(name: str, choices: Mapping[str, _Choice], what: str) -> _Choice:
    """What goes by that name.

    Raises:
        InputError: nothing does; the message lists the names.
    """
    if name not in choices:
        raise InputError(f"unknown {what} {name!r}: choose one of {', '.join(choices)}")
    return choices[name]


def differences(there: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """What is wanted and isn't there, for a message; nothing if all is."""
    return ", ".join(
        f"{name} {there.get(name)} (now: {value})"
        for name, value in wanted.items()
        if there.get(name) != value
    )
