"""statistics.json of earlier versions in today's form.

Records that aren't as expected raise a LookupError, TypeError or AttributeError, or are left to the
checks of the newest version.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from jbrep.stats.first_claims import FirstClaims
from jbrep.stats.labels import COMPONENTS

Record = Mapping[str, Any]

_NAMES = {
    "steps_to_900": "steps_to_solved",
    "reached_900": "reached_solved",
    "steps_to_900_ratio": "steps_to_solved_ratio",
}
# of the Jitterbug, which was the only robot: its rewards are never negative
_FACTS = {"return_floor": 0.0, "failure_return": 0.0, "reference": 0.0}
_NOTHING = [None, None, None]  # an interval


def in_version_2(record: Record) -> dict[str, Any]:
    """A record of version 1 in version 2.

    Numbers had 900 in their names, the return from which on a task counts as solved, and all groups
    shared one list of returns for their performance profiles.
    """
    shared = {**_FACTS, "profile_returns": record["profile_returns"]}

    def group(given: Record) -> dict[str, Any]:
        renamed = {
            "thresholds": _renamed(given["thresholds"]),
            "labels": [
                {**label, **{part: _renamed(label[part]) for part in ("by_run", "numbers")}}
                for label in given["labels"]
            ],
            "comparisons": [
                {**each, "numbers": _renamed(each["numbers"])} for each in given["comparisons"]
            ],
        }
        return {**shared, **given, **renamed}

    return {**record, "groups": [group(each) for each in record["groups"]]}


def _renamed(numbers: Record) -> dict[str, Any]:
    return {_NAMES.get(name, name): value for name, value in numbers.items()}


def in_version_3(record: Record) -> dict[str, Any]:
    """A record of version 2 in version 3.

    Its claims were those of the first release, with verdicts by intervals of one level.
    """
    error = 1 - record["simultaneous_level"]

    def group(given: Record) -> dict[str, Any]:
        counts = {label["representation"]: len(label["seeds"]) for label in given["labels"]}
        baseline, *_ = counts.values()
        return {
            "return_ceiling": None,
            "references": {},
            **given,
            "labels": [_with_components(label) for label in given["labels"]],
            "comparisons": [
                {
                    **each,
                    "verdicts": [
                        _verdict(verdict, error, [counts[each["representation"]], baseline])
                        for verdict in each["verdicts"]
                    ],
                }
                for each in given["comparisons"]
            ],
        }

    first = FirstClaims()
    return {
        **record,
        "claims": [asdict(claim) for claim in first.claims],
        "notes": list(first.notes),
        "groups": [group(each) for each in record["groups"]],
        "aggregates": [],
    }


def _with_components(label: Record) -> dict[str, Any]:
    numbers = {**label["numbers"], **dict.fromkeys(COMPONENTS, _NOTHING)}
    return {**label, "encoders": 1, "numbers": numbers}


def _verdict(given: Record, error: float, runs: list[int]) -> dict[str, Any]:
    seeds = given["seeds_needed"]
    return {
        **{name: given[name] for name in ("claim", "verdict", "boundary", "p")},
        "estimate": given["nominal"],
        "interval": given["simultaneous"],
        "level": error,
        "runs": runs,
        "encoders": 0,
        "look": 1,
        "reason": given["reason"] if seeds is None else f"{seeds} seeds would decide",
    }
