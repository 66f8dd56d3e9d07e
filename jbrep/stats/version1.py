"""statistics.json of the first release in today's form."""

from collections.abc import Callable, Mapping
from typing import Any

_NAMES = {
    "steps_to_900": "steps_to_solved",
    "reached_900": "reached_solved",
    "steps_to_900_ratio": "steps_to_solved_ratio",
}
# of the Jitterbug, which was the only robot: its rewards are never negative
_FACTS = {"return_floor": 0.0, "failure_return": 0.0, "reference": 0.0}


def in_version_2(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record of format version 1 in version 2; what isn't as expected stays for the checks.

    Numbers had 900 in their names, the return from which on a task counts as solved, and all groups
    shared one list of returns for their performance profiles.
    """
    shared = {name: record[name] for name in ("profile_returns",) if name in record}

    def group(given: dict[str, Any]) -> dict[str, Any]:
        parts = _changed(given, {"thresholds": _renamed, "labels": _label, "comparisons": _label})
        return {**_FACTS, **shared, **parts}

    return _changed(record, {"groups": lambda groups: _each(groups, group)})


def _label(labels: Any) -> Any:
    """The results of each representation, or its comparisons."""
    return _each(labels, lambda label: _changed(label, {"by_run": _renamed, "numbers": _renamed}))


def _each(values: Any, change: Callable[[dict[str, Any]], Any]) -> Any:
    if not isinstance(values, list):
        return values
    return [change(value) if isinstance(value, dict) else value for value in values]


def _changed(
    value: Mapping[str, Any], changes: Mapping[str, Callable[[Any], Any]]
) -> dict[str, Any]:
    return {name: changes.get(name, _same)(part) for name, part in value.items()}


def _same(value: Any) -> Any:
    return value


def _renamed(numbers: Any) -> Any:
    if not isinstance(numbers, dict):
        return numbers
    return {_NAMES.get(name, name): value for name, value in numbers.items()}
