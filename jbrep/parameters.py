"""Parameters that several functions and commands share: type, range, and what they mean.

The other parameters of a function are described in its docstring. `jbrep.cli.generator` makes the
options of commands from both.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from jbrep.errors import STEP_TIMEOUT, InputError
from jbrep.rl.presets import ALGORITHMS

if TYPE_CHECKING:
    from jbrep.envs.task import Task

NOTHING: Mapping[str, Any] = MappingProxyType({})
NumEnvs = Annotated[
    int, Meta(ge=1, le=100_000, description="Environments of a batch, stepped at once.")
]
Threads = Annotated[
    Annotated[int, Meta(ge=1, le=4096)] | None,
    Meta(
        description="Threads of a batch, or instances of other environments at once; as many as "
        "cores by default. A robot that exists once needs 1."
    ),
]
Retries = Annotated[
    int,
    Meta(
        ge=0,
        le=1_000_000,
        description="How often in a row a failing environment is made again; its first start "
        "isn't retried.",
    ),
]
Episodes = Annotated[
    int, Meta(ge=1, le=10_000, description="Episodes to play, the same each time.")
]
Backend = Annotated[
    str, Meta(description="Where it runs: local, or ray, the cluster that RAY_ADDRESS names.")
]
Workers = Annotated[
    Annotated[int, Meta(ge=1, le=1024)] | None,
    Meta(
        description="Processes at a time.",
        extra={"default": "one for each core; one if it learns on a GPU"},
    ),
]
TaskName = Annotated[
    str | None,
    Meta(
        description="One of the Jitterbug's tasks, such as face_direction, or a Gymnasium id: "
        "Hopper-v5."
    ),
]
Hide = Annotated[
    Sequence[str],
    Meta(
        description="A feature or group to remove, or a pattern, 'velocity_*'; may be repeated.",
        extra={"metavar": "NAME"},
    ),
]
History = Annotated[
    int,
    Meta(
        ge=1,
        le=1000,
        description="States that are seen at once, the current one and those before, with the "
        "actions between.",
    ),
]
Out = Annotated[Path, Meta(description="A folder.")]
NewFile = Annotated[Path, Meta(description="A new file.")]
Algorithm = Annotated[str, Meta(description=f"One of {', '.join(ALGORITHMS)}.")]
Preset = Annotated[
    str,
    Meta(
        description="Hyperparameters: paper, modern, wide, or a TOML file with a table for each "
        "algorithm.",
        extra={"default": "wide, or modern where that has none"},
    ),
]
Overrides = Annotated[
    Mapping[str, Any],
    Meta(
        description="A setting other than the preset's, by stable-baselines3's name, such as "
        "learning_rate=3e-4, net_arch=[64,64] or learning_rate=linear:3e-4; may be repeated.",
        extra={"option": "set"},
    ),
]
Normalize = Annotated[
    bool, Meta(description="Normalise what the agent sees by its running mean and variance.")
]
Observed = Annotated[
    Any,
    Meta(
        description="What the agent observes: full, the scaled observation; coordinates, symmetry, "
        "one that ships; an encoder's file; or code as module:Class, which is run.",
        extra={"is_code": True},
    ),
]
Acting = Annotated[Any, Meta(extra={"is_code": True})]  # a policy by a name or its code, or itself
AsJson = Annotated[bool, Meta(description="Print JSON, for programs.", extra={"option": "json"})]


def described(
    task: TaskName = None,
    env: Mapping[str, Any] = NOTHING,
    episode_steps: Annotated[int, Meta(ge=1)] | None = None,
    features: Path | None = None,
    missing: Annotated[str | None, Meta(extra={"metavar": "[skip|hold:N]"})] = None,
    hide: Hide = (),
    history: History = 1,
    action_bounds: Annotated[str | None, Meta(extra={"metavar": "LOW..HIGH"})] = None,
    step_timeout: Annotated[float, Meta(gt=0, le=1e6)] | None = None,
) -> "Task | None":
    """The task of that name, with what is said of its environment; None if nothing is.

    Args:
        env: an argument of the environment, such as g=1.6; may be repeated.
        episode_steps: the time limit of an episode; the environment's own by default.
        features: a TOML file with names, units, ranges, kinds and offsets of the features.
        missing: how to treat NaN and infinite readings: an episode ends before one, or the
            last one is held for at most N steps; otherwise they are errors.
        action_bounds: bounds of each action, or of all, such as -1..1; required where the
            environment has none.
        step_timeout: seconds after which a reset or step that hasn't come back has failed, as of a
            robot that stalls.
    """
    if step_timeout:
        os.environ[STEP_TIMEOUT] = str(step_timeout)  # for processes that are started, too
    if task is None:
        if env or episode_steps or features or missing or hide or history > 1 or action_bounds:
            raise InputError("give the `task`: one of the Jitterbug's, or a Gymnasium id")
        return None
    from jbrep.dataset.manifest import MANIFEST
    from jbrep.envs.description import describe
    from jbrep.envs.names import find_spec, name_given
    from jbrep.records.storage import exists

    named = name_given(task)
    try:
        find_spec(named)
    except InputError:
        for folder in (Path(task), Path("data", task)):
            if exists(folder / MANIFEST):
                raise InputError(
                    f"{task} is a data set, not a task: jbrep clone --data {folder} learns a "
                    "policy from it alone"
                ) from None
        raise
    said = env, episode_steps, features, missing, hide, history
    return describe(named, *said, action_bounds=action_bounds)


def drawn(
    domain: Mapping[str, Any] = NOTHING, **options: Annotated[Any, described]
) -> "Task | None":
    """A task that is described, with what its episodes draw.

    Args:
        domain: what each episode draws: noise, delay, dropped, action_delay, friction, mass, push
            or body, such as delay=0..2 or friction=0.5..1.5; may be repeated.
    """
    from jbrep.envs.description import with_domain

    task = described(**options)
    return with_domain(task, domain) if task and domain else task


# What Python calls a task by its name or itself is for a command what its options describe.
GivenTask = Annotated["Task | str", Meta(extra={"made_by": described})]
OptionalGivenTask = Annotated["Task | str | None", Meta(extra={"made_by": described})]
DrawnTask = Annotated["Task", Meta(extra={"made_by": drawn})]
GivenDrawnTask = Annotated["Task | str", Meta(extra={"made_by": drawn})]
OptionalTask = Annotated["Task | None", Meta(extra={"made_by": described})]


def find_study(name: str | Path) -> Path:
    """The file of a study: that path, or the one that ships under a name, such as demo."""
    shipped = Path(__file__).parent / "studies" / "shipped"
    ships = {each.stem: each for each in shipped.glob("*.toml")}
    if os.path.isfile(name):  # noqa: PTH113, Path.is_file raises where a name is too long
        return Path(name)
    if str(name) not in ships:
        choices = ", ".join(ships)
        raise InputError(f"no study {name}: give a TOML file, or one that ships: {choices}")
    return ships[str(name)]
