"""A study's plan, written down before its first run: what a report holds its runs against."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict

from jbrep.errors import DamageError, InputError, differences
from jbrep.records.commit import commits
from jbrep.records.storage import exists, read_regular, write_whole
from jbrep.records.typed import read_json, typed
from jbrep.rl.job import packages
from jbrep.study.config import as_study, known

REGISTRATION = "registration.json"
FORMAT = "jbrep registration"
FORMAT_VERSION = 1
_MAX_BYTES = 1 << 24
_HASHED = ("study", "encoders", "date", "versions", "commits")
_MAY_GROW = ("seeds",)  # after registration; what was added is exploratory


class Registration(TypedDict):
    """registration.json."""

    study: dict[str, Any]  # its settings
    encoders: dict[str, str]  # of those that were there: SHA-256 by the name of the run
    sha256: str  # of all else
    date: str  # ISO 8601, in UTC
    versions: dict[str, str]  # by package
    commits: dict[str, str]


def register(folder: Path, study: Mapping[str, Any], encoders: Mapping[str, str]) -> Registration:
    """Write a study's plan into its folder; one that is registered stays as it is.

    Args:
        folder: of the study.
        study: its settings as plain JSON.
        encoders: the SHA-256 of those that are there, by the name of the run.

    Raises:
        InputError: it is registered with other settings, or has runs already.
    """
    if there := read_registration(folder):
        check_registered(there, study, folder)
        return there
    if has_begun(folder):
        raise InputError(f"{folder} has runs: a study is registered before its first run")
    now = datetime.now(UTC).isoformat(timespec="seconds")
    facts = {
        "study": dict(study),
        "encoders": dict(encoders),
        "date": now,
        "versions": packages(),
        "commits": dict(commits()),
    }
    made = Registration(sha256=_hash(facts), **facts)  # type: ignore[typeddict-item]
    record = {"format": FORMAT, "format_version": FORMAT_VERSION, **made}
    write_whole(folder / REGISTRATION, (json.dumps(record, indent=2) + "\n").encode())
    return made


def has_begun(folder: Path) -> bool:
    """Whether a study has runs, at whatever step."""
    return any((folder / "runs").glob("**/*.*"))


def read_registration(folder: Path) -> Registration | None:
    """What was registered in a folder; None if nothing was.

    Raises:
        DamageError: the file was changed since, or is damaged.
        InputError: it is of a newer jbrep.
    """
    path = folder / REGISTRATION
    if not exists(path):
        return None
    try:
        text = read_regular(path, _MAX_BYTES).decode()
        record = read_json(text, path, FORMAT, FORMAT_VERSION)
        registration: Registration = typed(record, Registration)
        as_study(known(registration["study"]))
    except (OSError, ValueError) as error:
        raise DamageError(f"{path} is damaged: {error}") from None
    facts = {name: value for name, value in registration.items() if name in _HASHED}
    if _hash(facts) != registration["sha256"]:
        raise DamageError(
            f"{path} was changed after it was written: restore it, or choose another folder"
        )
    return registration


def check_registered(registration: Registration, study: Mapping[str, Any], folder: Path) -> None:
    """Check that a study is the one that was registered, but for seeds that were added.

    Raises:
        InputError: it isn't.
    """
    if differing := differences(registration["study"], _fixed(registration, study)):
        raise InputError(
            f"{folder} holds the study registered on {registration['date'][:10]}, and its file "
            f"was changed: {differing}; put it back, or choose another --out"
        )


def deviations(
    registration: Registration, study: Mapping[str, Any], runs: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """How what ran differs from what was registered, in sentences.

    Args:
        registration: of the study.
        study: its settings now.
        runs: contents of run.json, of all that have ended, by label and seed.
    """
    found = []
    if differing := differences(registration["study"], _fixed(registration, study)):
        found.append(f"settings differ: {differing}")
    registered = registration["study"]["seeds"]
    if added := [seed for seed in study["seeds"] if seed not in registered]:
        found.append(f"seeds were added, whose runs are exploratory: {_listed(added)}")
    every = list(runs.values())
    if strays := [
        run for run in every if run["settings"]["registration"] != registration["sha256"]
    ]:
        found.append(f"{len(strays)} of its runs weren't made under this registration")
    known = registration["encoders"]
    used = {name: run["settings"]["encoder"] for name, run in runs.items()}
    if other := [name for name, encoder in used.items() if known.get(name, encoder) != encoder]:
        found.append(f"{len(other)} of its runs have other encoders than there were")
    for name, version in registration["versions"].items():
        others = {run["versions"].get(name, "none") for run in every} - {version}
        if others:
            found.append(f"{name} was {_listed(sorted(others))}, not {version}")
    registered_commit = registration["commits"].get("jbrep")
    others = {run.get("commits", {}).get("jbrep") for run in every} - {registered_commit, None}
    if others:
        found.append("some runs were made by other commits of jbrep's code")
    return found


def _fixed(registration: Registration, study: Mapping[str, Any]) -> dict[str, Any]:
    """A study's settings, without what was added to what may grow."""
    kept = {
        name: [each for each in study[name] if each in registration["study"][name]]
        for name in _MAY_GROW
    }
    return {**study, **kept}


def _listed(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))


def _hash(facts: Mapping[str, Any]) -> str:
    canonical = json.dumps(facts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
