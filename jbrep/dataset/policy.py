"""What a manifest says of the policy that acted: its kind and its constants, as plain JSON."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

IMPORTED = "imported"  # data that were made elsewhere
MIXTURE = "mixture"  # a policy for each episode, by weights
TRAINED = "trained"  # of a run, kept in a file beside the shards
MAX_LETTERS = 200  # of a text
_MAX_NUMBER = 10**12
_MAX_CONSTANTS = 1000  # at each depth
_MAX_DEPTH = 6  # of lists and tables
_OF_FILE = {"file": r"policy-\d{1,3}\.safetensors", "sha256": "[0-9a-f]{64}"}


def is_policy(policy: Any) -> bool:
    """Whether it is a kind, which is a word, and constants that fit it."""
    if not isinstance(policy, Mapping) or not isinstance(policy.get("kind"), str):
        return False
    if not re.fullmatch("[a-z-]+", policy["kind"]) or not _is_plain(policy):
        return False
    check = {MIXTURE: _is_mixture, TRAINED: _is_trained}.get(policy["kind"])
    return check is None or check(policy)


def _is_plain(value: Any) -> bool:
    """Numbers and short text in lists and tables, few enough and not nested deeply."""
    level = [value]
    for _ in range(_MAX_DEPTH):
        values = [each for each in level if not _is_scalar(each)]
        if not all(isinstance(each, list | Mapping) for each in values):
            return False
        if sum(map(len, values)) > _MAX_CONSTANTS:
            return False
        level = [inner for each in values for inner in _inside(each)]
    return not level


def _inside(value: list[Any] | Mapping[Any, Any]) -> list[Any]:
    """The items of a list; the names, which must be text, and values of a table."""
    if isinstance(value, list):
        return value
    names = [name if isinstance(name, str) else None for name in value]
    return [*names, *value.values()]


def _is_scalar(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= MAX_LETTERS and value.isprintable()
    return isinstance(value, int | float) and type(value) is not bool and abs(value) < _MAX_NUMBER


def _is_mixture(policy: Mapping[str, Any]) -> bool:
    """Whether it has weights, which are positive, and policies that are no mixtures."""
    parts = policy.get("parts")
    return (
        policy.keys() == {"kind", "parts"}
        and isinstance(parts, list)
        and len(parts) > 1
        and all(isinstance(part, list) and len(part) == 2 for part in parts)
        and all(isinstance(weight, int | float) and weight > 0 for weight, _ in parts)
        and all(is_policy(part) and part["kind"] != MIXTURE for _, part in parts)
    )


def _is_trained(policy: Mapping[str, Any]) -> bool:
    """Whether it names its file, nowhere else than beside the shards, and the file's hash."""
    return (
        policy.keys() == {"kind", *_OF_FILE, "run", "step"}
        and all(re.fullmatch(form, str(policy[name])) for name, form in _OF_FILE.items())
        and isinstance(policy["run"], str)
        and isinstance(policy["step"], int)
    )


def parts_of(policy: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The policies of a mixture, or else the policy itself."""
    yield from (part for _, part in policy["parts"]) if policy["kind"] == MIXTURE else (policy,)


def policy_text(policy: Mapping[str, Any]) -> str:
    """A policy's kind and constants for people: "constant, drive 0.5"."""
    if policy["kind"] == MIXTURE:
        return "; ".join(f"{weight:.3g} of {policy_text(part)}" for weight, part in policy["parts"])
    hidden = ("kind", *_OF_FILE)
    constants = (f"{name} {value}" for name, value in policy.items() if name not in hidden)
    return ", ".join([policy["kind"], *constants])
