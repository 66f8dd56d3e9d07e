"""Exceptions for what a user can fix, and words for their messages."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from typing import Any, TypeVar

_Choice = TypeVar("_Choice")

_MOST_NAMES = 20
_MOST_SHOWN = 3  # settings that differ
_MOST_LETTERS = 40  # of a value
_BEFORE = 10  # letters that are shown before where two values differ


class InputError(ValueError):
    """A user's mistake: one line with what was wrong, what was expected, and the choices."""


class Notice(UserWarning):
    """What a user should know though work goes on; the command line shows it as a line."""


class DamageError(InputError):
    """A file is not what jbrep wrote; the message names it."""


class StoppedError(Exception):
    """A run stopped on request after so many steps, its checkpoint written; `train` resumes it."""

    def __init__(self, step: int):
        super().__init__(f"stopped after {step:,} steps")
        self.step = step


def first_line(error: BaseException) -> str:
    """The first line of an error's message; the name of its class where it has none."""
    return str(error).strip().partition("\n")[0] or type(error).__name__


def kind_and_line(error: BaseException) -> str:
    """The same after the name of its class, KeyError: 'x', unless it is a user's mistake."""
    kind, line = type(error).__name__, first_line(error)
    return line if line == kind or isinstance(error, InputError) else f"{kind}: {line}"


@contextmanager
def refusing(
    what: str,
    errors: tuple[type[Exception], ...] = (Exception,),
    *,
    told: Callable[[Any], str] = kind_and_line,
    kind: type[InputError] = InputError,
) -> Iterator[None]:
    """Let what goes wrong be a user's mistake, told in a line; one that is already, stays.

    Args:
        what: failed, or can't be, for the message.
        errors: that may come of it.
        told: what says in a line why.
        kind: of the error that is raised instead.
    """
    try:
        yield
    except InputError:
        raise
    except errors as error:
        raise kind(f"{what}: {told(error)}") from error


def choose(name: str, choices: Mapping[str, _Choice], what: str) -> _Choice:
    """The choice of that name."""
    if name not in choices:
        raise InputError(f"unknown {what} {name!r}: choose one of {', '.join(choices)}")
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
    differing = list(_differing(there, wanted))
    shown = [
        "{} {} (now: {})".format(name, *_shown(_word(before), _word(now)))
        for name, before, now in differing[:_MOST_SHOWN]
    ]
    more = len(differing) - _MOST_SHOWN
    return ", ".join([*shown, f"and {more} more"] if more > 0 else shown)


def _differing(
    there: Mapping[str, Any], wanted: Mapping[str, Any], where: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """The settings that differ, of tables the entries that do.

    Lists of tables that have names, such as features, count as tables if the names are alike.
    """
    for name in {**wanted, **there}:
        before, now = there.get(name), wanted.get(name)
        if (known := _named(before)) and (given := _named(now)):
            alike = [*known] == [*given]
            before, now = (known, given) if alike else ([*known], [*given])
        if isinstance(before, Mapping) and isinstance(now, Mapping):
            yield from _differing(before, now, f"{where}{name}.")
        elif before != now:
            yield f"{where}{name}", before, now


def _named(value: Any) -> dict[str, Any]:
    """A list of tables that have names of their own, as a table of them; of all else none."""
    if not isinstance(value, list | tuple):
        return {}
    tables = {each["name"]: each for each in value if isinstance(each, Mapping) and "name" in each}
    return tables if len(tables) == len(value) else {}


def _word(value: Any) -> str:
    """A setting as files spell it."""
    if value is None:
        return "none"
    return value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)


def _shown(*texts: str) -> Iterator[str]:
    """Texts that are cut where they are long, from a little before where they differ on."""
    pairs = enumerate(zip(*texts, strict=False))
    alike = next((place for place, letters in pairs if len({*letters}) > 1), min(map(len, texts)))
    begin = alike - _BEFORE if alike > _MOST_LETTERS // 2 else 0
    for text in texts:
        if len(text) > _MOST_LETTERS:
            text = f"...{text[begin:]}" if begin else text
            some = _MOST_LETTERS + 3 if begin else _MOST_LETTERS
            text = text if len(text) <= some else f"{text[: some - 3]}..."
        yield text
