"""Exceptions for what a user can fix, and words for their messages."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any, TypeVar

_Choice = TypeVar("_Choice")

_MOST_NAMES = 20
_MOST_SHOWN = 3  # settings that differ
_MOST_LETTERS = 40  # of a value
STEP_TIMEOUT = "JBREP_STEP_TIMEOUT"  # a variable: seconds that an environment may take
_MOST = 500  # letters of a stranger's message


class InputError(ValueError):
    """A user's mistake: one line with what was wrong, what was expected, and the choices."""


class Notice(UserWarning):
    """What a user should know though work goes on; the command line shows it as a line."""


class DamageError(InputError):
    """A file is not what jbrep wrote; the message names it. Whatever reads one may raise it."""


class StoppedError(Exception):
    """A run stopped on request after so many steps, its checkpoint written; `train` resumes it."""

    def __init__(self, step: int):
        super().__init__(f"stopped after {step:,} steps")
        self.step = step


class StoppedProcess(SystemExit):
    """Ctrl-C or SIGTERM ends this process."""


def first_line(error: BaseException) -> str:
    """The first line of an error's message, not too long; its class where it has none."""
    try:
        line = str(error).strip().partition("\n")[0]
    except Exception:  # in a stranger's `__str__`
        line = ""
    return (line if len(line) <= _MOST else f"{line[:_MOST]}...") or type(error).__name__


def kind_and_line(error: BaseException) -> str:
    """The same after the name of its class, KeyError: 'x', unless it is a user's mistake."""
    kind, line = type(error).__name__, first_line(error)
    return line if line == kind or isinstance(error, InputError) else f"{kind}: {line}"


@contextmanager
def refusing(
    what: str,
    errors: tuple[type[Exception], ...] = (Exception,),
    *,
    describe: Callable[[Any], str] = kind_and_line,
    kind: type[InputError] = InputError,
) -> Iterator[None]:
    """Turn errors of these classes into a user's mistake: what failed, and why, in a line."""
    try:
        yield
    except InputError:
        raise
    except errors as error:
        raise kind(f"{what}: {describe(error)}") from error


def choose(name: str, choices: Mapping[str, _Choice], what: str) -> _Choice:
    """The choice of that name."""
    if name not in choices:
        near = get_close_matches(name, choices, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise InputError(f"unknown {what} {name!r}: {hint}choose one of {', '.join(choices)}")
    return choices[name]


def matching(
    wanted: Iterable[str], names: Sequence[str], groups: Sequence[str], of: str
) -> list[int]:
    """Places of what is wanted, in that order and each once.

    Args:
        wanted: a name, the name of a group, or a pattern of either, such as velocity_*; each.
        names: of all that there is.
        groups: of each of them.
        of: what has them, for the message: "face_direction has no feature".
    """
    pairs, places = [*zip(names, groups, strict=True)], dict[str, list[int]]()
    for place, pair in enumerate(pairs):
        for name in dict.fromkeys(pair):
            places.setdefault(name, []).append(place)
    found: dict[int, None] = {}
    for name in wanted:
        some = places.get(name) or [
            place for place, pair in enumerate(pairs) if any(fnmatchcase(p, name) for p in pair)
        ]
        if not some:
            raise InputError(f"{of} {name!r}: it has {listed([*places])}")
        found |= dict.fromkeys(some)
    return [*found]


def listed(names: Sequence[str]) -> str:
    """Names for a message: the first ones, where there are many."""
    return ", ".join(names[:_MOST_NAMES]) + (", ..." if names[_MOST_NAMES:] else "")


def differences(there: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """The settings that differ, as text for a message: at most three; empty if none does."""
    differing = [*_differing(there, wanted)]
    shown = [
        name if before == now else f"{name} {before} (now: {now})"
        for name, before, now in differing[:_MOST_SHOWN]
    ]
    more = len(differing) - _MOST_SHOWN
    return ", ".join([*shown, f"and {more} more"] if more > 0 else shown)


def _differing(
    there: Mapping[str, Any], wanted: Mapping[str, Any], where: str = ""
) -> Iterator[tuple[str, str, str]]:
    """The settings that differ, of tables the entries that do, as short text."""
    for name in {**wanted, **there}:
        before, now = there.get(name), wanted.get(name)
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _differing(before, now, f"{where}{name}.")
        elif before != now:
            yield f"{where}{name}", _word(before), _word(now)


def _word(value: Any) -> str:
    """A setting as files spell it, cut where it is long."""
    if value is None:
        return "none"
    text = value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= _MOST_LETTERS else f"{text[: _MOST_LETTERS - 3]}..."
