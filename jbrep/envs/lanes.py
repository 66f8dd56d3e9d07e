"""Lanes: many environments of one task, each reset with a seed of its own and stepped together."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.disturbed import Disturbed
from jbrep.envs.infos import Numbers
from jbrep.envs.make import is_batched, make_batch
from jbrep.envs.separate import EnvironmentFailedError as EnvironmentFailedError
from jbrep.envs.separate import Flags as Flags
from jbrep.envs.separate import Retries as Retries
from jbrep.envs.separate import Separate
from jbrep.envs.separate import State as State
from jbrep.envs.task import Array, Task
from jbrep.envs.view import Seen
from jbrep.errors import InputError


class NonFiniteActionError(InputError):
    """An action is NaN or infinite."""


def check_counts(num_lanes: int, num_threads: int | None) -> None:
    """Check the numbers of lanes and threads."""
    for count, what in ((num_lanes, "lanes"), (num_threads, "threads")):
        if count is not None and count < 1:
            raise InputError(f"the number of {what} is {count}: it must be at least 1")


def lanes_at_once(task: Task, most: int, threads: int | None, retries: int) -> "Lanes":
    """At most so many lanes as there may be: one of a robot that exists once."""
    try:
        return Lanes(task, most, threads, Retries(retries))
    except InputError:
        if most == 1 or is_batched(task):
            raise
    return Lanes(task, 1, threads, Retries(retries))


def check_actions(actions: ArrayLike, num_lanes: int, size: int) -> NDArray[np.float64]:
    """The actions as (num_lanes, size) float64, all finite."""
    checked: NDArray[np.float64] = np.asarray(actions, dtype=np.float64)
    if checked.shape != (num_lanes, size):
        raise InputError(
            f"actions have shape {checked.shape}: it must be ({num_lanes}, {size}), one action for "
            "each lane"
        )
    if not math.isfinite(checked.sum()) and not np.isfinite(checked).all():
        raise NonFiniteActionError(f"actions are not finite: {checked.ravel()}")
    return checked


class Step(NamedTuple):
    """What a step of n lanes led to; treat the arrays as read-only."""

    observation: Array  # (n, d) of the new states; the last one of its episode where that ended
    reward: Array  # (n,) 0 in a lane whose episode had ended before
    terminated: Flags  # (n,) true from the step on that ended the episode
    truncated: Flags  # (n,) likewise; also where the physics diverged
    arrays: Mapping[str, Array]  # those of the task's `state` and `constants`, (n, width) each


class Lanes:
    """n lanes of a task, each going through an episode at a time.

    A lane whose episode has ended stands still until it is reset. What a lane does depends on its
    own seed and actions alone, not on the number of lanes or threads.

    Args:
        task: whose environment is made.
        num_lanes: n.
        num_threads: threads to step a batch on; None takes one for each core.
        retries: of failures of separate environments, each of which ends an episode before the step
            that failed; by default none.

    Attributes:
        observation: the current one of each lane, (n, d) in physical units.
        arrays: the current ones of the task's `state` and `constants`, (n, width) each.
        info: all that a batch tells of its lanes, by name, (n, ...) each.
        terminated, truncated: how each lane's episode has ended, (n,).
        active: whether it goes on, (n,); num_active: in how many lanes it does.
        lost: whether the last step led to nothing that can be used, (n,): it doesn't count, and its
            episode ended before it, truncated.
        missing: readings that were missing in each lane's episode, (n,).
        envs: the environments themselves: a batch, or one for each lane.
    """

    def __init__(
        self,
        task: Task,
        num_lanes: int,
        num_threads: int | None = None,
        retries: Retries | None = None,
    ):
        check_counts(num_lanes, num_threads)
        self.task, self.num_lanes = task, num_lanes
        if is_batched(task):
            if task.offset.any():
                raise InputError(f"{task.name} is stepped as a batch: its features have no offsets")
            self._batch: Any = make_batch(task, num_lanes, num_threads)
            self.envs: Any = self._batch
        else:
            self._batch = Separate(task.whole, num_lanes, retries or Retries())
            self.envs = self._batch.envs
        if task.domain:
            self._batch = Disturbed(self._batch, task, num_lanes)
        if task.view:
            self._batch = Seen(self._batch, task, num_lanes)
        self.lost = np.zeros(num_lanes, np.bool_)
        self.missing: NDArray[np.int64] = getattr(
            self._batch, "missing", np.zeros(num_lanes, np.int64)
        )
        self.observation = np.zeros((num_lanes, task.size))
        self.arrays: Mapping[str, Array] = {}
        self.info: Mapping[str, Any] = {}
        self._names = tuple(task.arrays)
        self.terminated = self.truncated = np.ones(num_lanes, dtype=np.bool_)
        self._count()
        self._seeds = np.zeros(num_lanes, np.int64)
        self._steps = np.zeros(num_lanes, np.int64)

    def __repr__(self) -> str:
        return f"Lanes({self.task.name}, {self.num_lanes:,})"

    @property
    def has_failed(self) -> bool:
        """Whether an environment failed in an episode of now, which ended early thereby."""
        return bool(np.any(getattr(self._batch, "failed", False)))

    @property
    def numbers(self) -> list[Numbers]:
        """What each lane's last step told in `info`, see `Separate`; batches tell nothing."""
        return getattr(self._batch, "numbers", None) or [{} for _ in range(self.num_lanes)]

    @property
    def steps(self) -> NDArray[np.int64]:
        """That each lane's episode has had so far, (n,)."""
        return self._steps.copy()

    def reset(self, lanes: Sequence[int], seeds: Sequence[int]) -> Array:
        """Start an episode in each of the lanes, with its seed.

        Returns:
            The current observations of all lanes, (n, d).
        """
        at = np.asarray(lanes)
        self._seeds[at], self._steps[at] = seeds, 0
        self.terminated, self.truncated = self.terminated.copy(), self.truncated.copy()
        self.terminated[at] = self.truncated[at] = False
        self._count()
        given = dict(zip(lanes, map(int, seeds), strict=True))
        every = [given.get(lane) for lane in range(self.num_lanes)]
        mask = np.isin(np.arange(self.num_lanes), lanes)
        observation, info = self._batch.reset(seed=every, options={"reset_mask": mask})
        self._check(observation, np.zeros(self.num_lanes), "reset gave")
        self._see(observation, info)
        return observation

    def step(self, actions: ArrayLike) -> Step:
        """Take one step in every lane whose episode goes on; actions (n, k)."""
        checked = check_actions(actions, self.num_lanes, self.task.action_size)
        active = self.active
        self._steps += active
        observation, reward, terminated, truncated, info = self._batch.step(checked)
        arrays = {name: info[name] for name in self._names}
        if self.num_active < self.num_lanes:
            here = active[:, None]
            observation = np.where(here, observation, self.observation)
            arrays = {n: np.where(here, values, self.arrays[n]) for n, values in arrays.items()}
            reward = np.where(active, reward, 0.0)
            terminated = np.where(active, terminated, self.terminated)
            truncated = np.where(active, truncated, self.truncated)
        self._check(observation, reward, "gave")
        self.observation, self.arrays, self.info = observation, arrays, info
        self.terminated, self.truncated = terminated, truncated
        self.lost = getattr(self._batch, "lost", self.lost)
        self._steps -= self.lost
        self._count()
        return Step(observation, reward, terminated, truncated, arrays)

    @property
    def metadata(self) -> Mapping[str, Any]:
        """What an environment says of itself, such as its `render_fps`."""
        return self._batch.metadata

    def render(self) -> Sequence[Any]:
        """What the environment of each lane draws, as its `render_mode` says."""
        return self._batch.render()

    def abandon(self) -> None:
        """Leave all episodes as if they had ended."""
        self.terminated = np.ones(self.num_lanes, dtype=np.bool_)
        self._count()

    def close(self) -> None:
        """Free what the environments hold; a separate one is kept for the next who needs it."""
        self._batch.close()

    def __enter__(self) -> "Lanes":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _see(self, observation: Array, info: Mapping[str, Any]) -> None:
        self.observation, self.info = observation, info
        self.arrays = {name: info[name] for name in self._names}

    def _count(self) -> None:
        self.active = ~(self.terminated | self.truncated)
        self.num_active = int(np.count_nonzero(self.active))

    def _check(self, observation: Array, reward: Array, did: str) -> None:
        """Make sure that all numbers are finite."""
        if math.isfinite(observation.sum() + reward.sum()):
            return
        good = np.isfinite(observation).all(axis=1) & np.isfinite(reward)
        if good.all():
            return  # their sum overflows
        lane = int(np.flatnonzero(~good)[0])
        raise EnvironmentFailedError(
            f"{self.task.name} {did} an observation or reward that is not finite, at step "
            f"{self._steps[lane]} of the episode with seed {self._seeds[lane]}"
        )
