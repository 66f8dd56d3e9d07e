"""Single episodes with all there is to see of them: replayed from a data set, or played anew."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Actor
from jbrep.dataset import Dataset
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import (
    CONTROL_TIMESTEP,
    EPISODE_STEPS,
    Array,
    Readings,
    Task,
    upright_term,
    yaw_direction,
)
from jbrep.progress import Progress

Begin = Callable[[Task, Sequence[np.random.Generator]], Actor]  # as `Policy.begin`


@dataclass(frozen=True, eq=False)
class Rollout:
    """An episode of n control steps; states come before, between and after the steps.

    Args:
        task: what is observed and rewarded.
        name: where it comes from, in words.
        seed: that the episode starts from.
        qpos: (n + 1, 16).
        qvel: (n + 1, 15).
        rotation: body to world, row by row, (n + 1, 9).
        velocity: of the body's centre of mass, world frame [m/s], (n + 1, 3).
        target_position: (3,).
        target_quaternion: (4,).
        action: the drives, (n, 1).
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

    def __len__(self) -> int:
        return len(self.action)

    @property
    def time(self) -> Array:
        """Simulated time of the states [s], (n + 1,)."""
        return CONTROL_TIMESTEP * np.arange(len(self.qpos), dtype=np.float64)

    @cached_property
    def readings(self) -> Readings:
        """What the tasks read of the states."""
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
        """In physical units, (n + 1, d)."""
        return self.task.observe(self.readings)

    @property
    def reward(self) -> Array:
        """Of the states that the steps led to, (n,)."""
        return self.task.reward(self.readings)[1:]

    @property
    def terms(self) -> dict[str, Array]:
        """The factors of the reward of each state, (n + 1,) each."""
        return {
            term.__name__.removesuffix("_term"): term(self.readings)
            for term in (upright_term, *self.task.terms)
        }


def replay(dataset: Dataset, episode: int) -> Rollout:
    """An episode of a data set, simulated again from its start and actions, bit for bit.

    Raises:
        InputError: the data set has no such episode, or it has no steps.
    """
    own = dataset.episodes
    if not 0 <= episode < len(own["episode"]):
        raise InputError(
            f"{dataset.folder} has no episode {episode}: it has {len(own['episode']):,}, from 0"
        )
    length, first = int(own["length"][episode]), int(own["length"][:episode].sum())
    if not length:
        raise InputError(f"episode {episode} of {dataset.folder} has no steps: choose another")
    names = ("initial_qpos", "initial_qvel", "target_position", "target_quaternion")
    simulation = Simulation(dataset.task, 1, num_threads=1)
    simulation.restore(*(own[name][episode : episode + 1] for name in names))
    actions = iter(dataset["action"][first : first + length])
    tape = _play(simulation, lambda: next(actions)[None], length)
    name = f"{dataset.folder}, episode {episode}"
    return tape.rollout(0, name, int(own["seed"][episode]))


def play(
    task: Task,
    begin: Begin,
    name: str,
    seeds: Sequence[int],
    target_yaw: float | None = None,
    steps: int = EPISODE_STEPS,
) -> list[Rollout]:
    """Episodes under a policy, an episode for each seed; one that diverges ends before it does.

    Args:
        task: what is observed.
        begin: the policy's.
        name: what the policy is called.
        seeds: an episode starts as a Gymnasium environment reset with its seed.
        target_yaw: turns the target of every episode there [rad].
        steps: control steps in an episode.
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
    tape = _play(simulation, lambda: act(simulation.observe()), steps, show=True)
    return [tape.rollout(lane, name, seed) for lane, seed in enumerate(seeds)]


class _Tape:
    """What n lanes go through, time first."""

    def __init__(self, simulation: Simulation, steps: int):
        n, now = simulation.num_lanes, simulation.readings
        self._simulation = simulation
        self._states = {
            name: np.empty((steps + 1, *getattr(now, name).shape))
            for name in ("qpos", "qvel", "rotation", "velocity")
        }
        # at the start: a lane that diverges loses its target
        self._target_position = now.target_position.copy()
        self._target_quaternion = simulation.target_quaternion.copy()
        self._action = np.empty((steps, n, 1))
        self._length = np.full(n, steps)

    def record_state(self, step: int) -> None:
        for name, values in self._states.items():
            values[step] = getattr(self._simulation.readings, name)

    def record_step(self, step: int, action: Array, diverged: NDArray[np.bool_]) -> None:
        self._action[step] = action
        self._length[diverged] = np.minimum(self._length[diverged], step)

    def rollout(self, lane: int, name: str, seed: int) -> Rollout:
        length = self._length[lane]
        return Rollout(
            task=self._simulation.task,
            name=name,
            seed=seed,
            **{key: values[: length + 1, lane] for key, values in self._states.items()},
            target_position=self._target_position[lane],
            target_quaternion=self._target_quaternion[lane],
            action=self._action[:length, lane],
        )


def _play(
    simulation: Simulation, act: Callable[[], Array], steps: int, show: bool = False
) -> _Tape:
    tape = _Tape(simulation, steps)
    tape.record_state(0)
    for step in Progress(range(steps), unit="step", leave=False, delay=1, disable=not show):
        action = act()
        tape.record_step(step, action, simulation.step(action))
        tape.record_state(step + 1)
    return tape
