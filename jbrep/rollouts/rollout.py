"""Single episodes to look at: replayed from a data set, or played by a policy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jbrep.collect.replay import simulate_again
from jbrep.dataset import Dataset
from jbrep.errors import InputError
from jbrep.jitterbug.episodes import Actor, Recording, record
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import (
    CONTROL_TIMESTEP,
    EPISODE_STEPS,
    QPOS_SIZE,
    QVEL_SIZE,
    Array,
    Readings,
    Task,
    upright_term,
    yaw_direction,
)
from jbrep.progress import Progress

Begin = Callable[[Task, Sequence[np.random.Generator]], Actor]  # as `Policy.begin`

_STATES = {"qpos": QPOS_SIZE, "qvel": QVEL_SIZE, "rotation": 9, "velocity": 3}  # and their widths


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """An episode of n control steps; states are before, between and after the steps.

    Args:
        task: what is observed and rewarded.
        name: where the episode comes from, for titles.
        seed: of the episode's start.
        qpos: (n + 1, 16).
        qvel: (n + 1, 15).
        rotation: body to world, row by row, (n + 1, 9).
        velocity: of the body's centre of mass, world frame [m/s], (n + 1, 3).
        target_position: (3,).
        target_quaternion: (4,).
        action: the drives, (n, 1).

    Raises:
        InputError: an array of another shape.
    """

    task: Task
    name: str
    seed: int
    qpos: Array
    qvel: Array
    rotation: Array
    velocity: Array
    target_position: Array
    target_quaternion: Array
    action: Array

    def __post_init__(self) -> None:
        steps = len(self.action)
        shapes: dict[str, tuple[int, ...]] = {
            "action": (steps, 1),
            **{name: (steps + 1, width) for name, width in _STATES.items()},
            "target_position": (3,),
            "target_quaternion": (4,),
        }
        for name, shape in shapes.items():
            if (actual := getattr(self, name).shape) != shape:
                raise InputError(
                    f"a rollout of {steps} actions has {name} of shape {actual}: it must be {shape}"
                )

    def __len__(self) -> int:
        return len(self.action)

    def __repr__(self) -> str:
        return f"Rollout({self.name!r}: {self.task.name}, {len(self):,} steps)"

    @property
    def time(self) -> Array:
        """Time of each state [s], (n + 1,)."""
        return CONTROL_TIMESTEP * np.arange(len(self.qpos), dtype=np.float64)

    @cached_property
    def readings(self) -> Readings:
        """The readings of all states, as a batch of n + 1."""
        states = (len(self.qpos), 1)
        return Readings(
            self.qpos,
            self.qvel,
            self.rotation,
            self.velocity,
            np.tile(self.target_position, states),
            np.tile(yaw_direction(self.target_quaternion[None]), states),
        )

    @cached_property
    def observation(self) -> Array:
        """Of each state, in physical units, (n + 1, d)."""
        return self.task.observe(self.readings)

    @property
    def reward(self) -> Array:
        """Of the state that each step led to, (n,)."""
        return self.task.reward(self.readings)[1:]

    @property
    def terms(self) -> dict[str, Array]:
        """The factors of the reward of each state, (n + 1,) each."""
        return {
            term.__name__.removesuffix("_term"): term(self.readings)
            for term in (upright_term, *self.task.terms)
        }


def replay(dataset: Dataset, episode: int) -> Rollout:
    """Simulate an episode of a data set again from its start and actions, bit for bit.

    Raises:
        InputError: the data set has no such episode, or it has no steps.
    """
    stored = dataset.episode(episode)
    if not len(stored):
        raise InputError(f"episode {episode} of {dataset.folder} has no steps: choose another")
    recording = simulate_again([stored], tuple(_STATES), num_threads=1, tick=lambda steps: None)
    name, seed = f"{dataset.folder}, episode {episode}", int(stored.record["seed"])
    return _rollout(dataset.task, recording, 0, name, seed)


def play(
    task: Task,
    begin: Begin,
    name: str,
    seeds: Sequence[int],
    target_yaw: float | None = None,
    steps: int = EPISODE_STEPS,
) -> list[Rollout]:
    """Play one episode for each seed; an episode ends before its physics diverges.

    Args:
        task: what is observed and rewarded.
        begin: of the policy.
        name: of the policy.
        seeds: an episode starts like a Gymnasium environment reset with its seed.
        target_yaw: orientation of the target in every episode [rad]; None draws it.
        steps: length of an episode in control steps.
    """
    simulation = Simulation(task, len(seeds))
    randoms = [np.random.default_rng(seed) for seed in seeds]
    simulation.reset(range(len(seeds)), randoms)
    if target_yaw is not None:
        turned = np.array([np.cos(target_yaw / 2), 0, 0, np.sin(target_yaw / 2)])
        simulation.restore(
            **simulation.state | {"target_quaternion": np.tile(turned, (len(seeds), 1))}
        )
    act = begin(task, randoms)
    total = steps * len(seeds)
    with Progress(total=total, unit="step", unit_scale=True, leave=False, delay=1) as progress:
        recording = record(simulation, act, steps, tuple(_STATES), progress.update)
    return [_rollout(task, recording, lane, name, seed) for lane, seed in enumerate(seeds)]


def _rollout(task: Task, recording: Recording, lane: int, name: str, seed: int) -> Rollout:
    length = recording.length[lane]
    return Rollout(
        task=task,
        name=name,
        seed=seed,
        **{key: recording.states[key][: length + 1, lane] for key in _STATES},
        # at the start: a lane that diverges loses its target
        target_position=recording.start["target_position"][lane],
        target_quaternion=recording.start["target_quaternion"][lane],
        action=recording.action[:length, lane],
    )
