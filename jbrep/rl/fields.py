"""What each field of run.json may hold: a folder may come from a stranger."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jbrep.envs.task import MAX_EPISODE_STEPS, Task
from jbrep.errors import DamageError
from jbrep.jitterbug.tasks import EPISODE_STEPS, get_task
from jbrep.records.commit import are_commits
from jbrep.records.record import from_plain, to_plain
from jbrep.rl.names import CPU, DEVICES, FLOAT32, PRECISIONS, SB3, TRAINERS, base_name

FINISHED, FAILED = "finished", "failed"
MAX_STEPS = 10**12  # of training
MAX_EVALUATION_EPISODES = 10_000
MAX_SEED = (1 << 31) - 1
MAX_LAYERS, MAX_UNITS = 8, 1024  # of a policy's network
MAX_ENVS = 4096
_MAX_LATENT = 1 << 20
_MAX_SECONDS = 1e12
MAX_LINE = 1000  # characters
MAX_NAME = 100  # characters, of a learner


class Kind(NamedTuple):
    """The values that a field may have."""

    allows: Callable[[Any], object]  # true for those
    words: str


def whole_number(least: int, most: int) -> Kind:
    """A whole number in a range, both ends included."""
    return Kind(
        lambda value: type(value) is int and least <= value <= most,
        f"a whole number from {least} to {most:,}",
    )


def text(pattern: str, words: str) -> Kind:
    """A string that a regular expression matches as a whole."""
    return Kind(lambda value: isinstance(value, str) and re.fullmatch(pattern, value), words)


def _is_line(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= MAX_LINE and value.isprintable()


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


def is_hidden(value: Any) -> bool:
    """Whether a value says the units of hidden layers, of a policy or of its parts."""
    if isinstance(value, dict):
        return 0 < len(value) <= 2 and all(map(_are_layers, value.values()))
    return _are_layers(value)


def _are_layers(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) <= MAX_LAYERS
        and all(type(units) is int and 1 <= units <= MAX_UNITS for units in value)
    )


HIDDEN = Kind(
    is_hidden,
    f"a list of at most {MAX_LAYERS} whole numbers from 1 to {MAX_UNITS:,}, or an object of such "
    "lists",
)
_TASK = text(r"[\w./-]{1,200}", "a task's name or id")
NAME = text(r"[\w.-]{1,100}", "a name of letters, digits, dots, hyphens and underscores")
LEARNER = text(
    rf"[\w.+=-]{{1,{MAX_NAME}}}", f"at most {MAX_NAME} letters, digits and characters of . _ - + ="
)
_SHA256 = text("[0-9a-f]{64}", "64 hexadecimal digits")
_LINE = Kind(_is_line, f"a line of at most {MAX_LINE:,} characters")
_OBJECT = Kind(lambda value: isinstance(value, dict), "an object")

_RUN = {
    "status": text(f"{FINISHED}|{FAILED}", f"{FINISHED} or {FAILED}"),
    "settings": _OBJECT,
    "steps": whole_number(0, MAX_STEPS),
    "seconds": Kind(lambda v: _is_number(v) and 0 <= v <= _MAX_SECONDS, "a number from 0"),
    "versions": Kind(
        lambda v: isinstance(v, dict) and all(map(_is_line, [*v, *v.values()])),
        "an object of strings",
    ),
    "cpu": _LINE,
}
_OPTIONAL = {
    "reason": _LINE,
    "policy_sha256": _SHA256,
    "latent_size": whole_number(1, _MAX_LATENT),  # early runs have it in their encoder alone
    "commits": Kind(are_commits, "an object of git commits"),
}
_SHA256_OR_NULL = Kind(lambda v: v is None or _SHA256.allows(v), f"null or {_SHA256.words}")
_SETTINGS = {
    "task": _TASK,
    "environment": _OBJECT,
    "algorithm": NAME,
    "preset": NAME,
    "hidden": HIDDEN,
    "settings": _OBJECT,
    "num_envs": whole_number(1, MAX_ENVS),
    "noise": Kind(
        lambda v: v is None or (isinstance(v, list) and all(map(_is_number, v))),
        "null or a list of numbers",
    ),
    "optimizer": _OBJECT,
    "policy": _OBJECT,
    "normalize": Kind(lambda v: isinstance(v, bool), "true or false"),
    "overrides": _OBJECT,
    "learner": LEARNER,
    "representation": NAME,
    "encoder": _SHA256,
    "encoder_code": Kind(lambda v: v is None or _is_line(v), "null or a name of code"),
    "encoder_seed": Kind(
        lambda v: v is None or whole_number(0, MAX_SEED).allows(v), "null or a whole number"
    ),
    "seed": whole_number(0, MAX_SEED),
    "steps": whole_number(1, MAX_STEPS),
    "evaluate_every": whole_number(1, MAX_STEPS),
    "evaluation_episodes": whole_number(1, MAX_EVALUATION_EPISODES),
    "final_episodes": whole_number(1, MAX_EVALUATION_EPISODES),
    "trainer": text("|".join(TRAINERS), " or ".join(TRAINERS)),
    "precision": text("|".join(PRECISIONS), " or ".join(PRECISIONS)),
    "device": text("|".join(DEVICES), " or ".join(DEVICES)),
    "from": _SHA256_OR_NULL,
    "registration": _SHA256_OR_NULL,
}
POLICY = {"activation_fn": "relu"}  # arguments of every policy unless a run sets others
_ADDED = {  # what early runs of this version lack
    "encoder_code": None,
    "encoder_seed": None,
    "policy": POLICY,
    "normalize": False,
    "overrides": {},
    "trainer": SB3,
    "precision": FLOAT32,
    "device": CPU,
    "registration": None,
}
_POLICY_FILE = {
    "settings": _OBJECT,
    "encoder": _OBJECT,
    "run": _LINE,
    "step": whole_number(0, MAX_STEPS),
    "finished": Kind(lambda v: isinstance(v, bool), "true or false"),
}
_VERSION_1 = {"task": _TASK, "episode_steps": whole_number(1, MAX_EPISODE_STEPS)}


def completed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run, with what those of an earlier jbrep leave unsaid."""
    name = base_name(settings.get("algorithm", ""), settings.get("preset", ""))
    episodes = {"final_episodes": settings.get("evaluation_episodes")}
    return {**_ADDED, **episodes, "learner": name, **settings}


def check_run(path: Path, run: Mapping[str, Any]) -> None:
    """Make sure that all fields of a run.json are there, of their types and in range.

    Raises:
        DamageError: one isn't; the message names it.
    """
    _check(path, run, _RUN)
    _check(path, run, {name: kind for name, kind in _OPTIONAL.items() if name in run})
    check_settings(path, run["settings"])


def check_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """The same for the settings of a run alone.

    Raises:
        DamageError: as `check_run`.
    """
    _check(path, settings, _SETTINGS, "settings.")
    try:
        task = from_plain(settings["environment"], Task)
    except ValueError as error:
        raise _damaged(path, f"settings.environment is invalid: {error}") from None
    if task.name != settings["task"]:
        raise _damaged(path, f"settings.environment is of {task.name}")


def check_policy(path: Path, header: Mapping[str, Any]) -> None:
    """The same for the header of a policy's file, but for its settings.

    Raises:
        DamageError: as `check_run`.
    """
    _check(path, header, _POLICY_FILE)


def from_version_1(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a run of version 1 in the form of this one: a Jitterbug's, begun anew.

    Raises:
        InputError: an unknown task.
        DamageError: a field isn't of its type or in range.
    """
    own = {"episode_steps": EPISODE_STEPS, **settings}
    _check(path, own, _VERSION_1, "settings.")
    task = get_task(own["task"]).describe(max_episode_steps=own.pop("episode_steps"))
    return {**own, "environment": to_plain(task), "from": None}


def _check(
    path: Path, values: Mapping[str, Any], kinds: Mapping[str, Kind], prefix: str = ""
) -> None:
    for name, kind in kinds.items():
        if name not in values or not kind.allows(values[name]):
            state = "invalid" if name in values else "missing"
            raise _damaged(path, f"{prefix}{name} is {state}, it must be {kind.words}")


def _damaged(path: Path, reason: str) -> DamageError:
    return DamageError(f"{path} is damaged or not from a jbrep run: {reason}")
