"""Many environments of one task, each reset with a seed of its own and stepped together."""

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.disturbed import Disturbed
from jbrep.envs.infos import SUCCESS, Numbers, number_of, numbers_in
from jbrep.envs.isolation import OURS, in_time, isolated
from jbrep.envs.make import (
    action_in,
    discard,
    flattener,
    give_back,
    is_batched,
    make_batch,
    number,
    of_size,
    take,
)
from jbrep.envs.task import Array, Task, most_held
from jbrep.envs.view import ViewedBatch
from jbrep.errors import STEP_TIMEOUT, InputError, Notice, kind_and_line

Flags = NDArray[np.bool_]
State = dict[str, NDArray[Any]]
_LARGEST = float(np.finfo(np.float32).max)  # that data sets and agents can have


class NonFiniteActionError(InputError):
    """An action is NaN or infinite."""


class EnvironmentFailedError(InputError):
    """An environment raised an error, or gave something else than its task's description says."""


class Retries:
    """How often what fails is tried again, in a row."""

    def __init__(self, most: int = 0):
        if most < 0:
            raise InputError(f"`retries` is {most}: it must be at least 0")
        self._most = self._left = most

    def failed(self, error: Exception) -> None:
        """Tell of a failure, or raise it if there were as many before."""
        if not self._left:
            raise error
        self._left -= 1
        warnings.warn(f"{error}; retrying", Notice, stacklevel=2)

    def succeeded(self) -> None:
        """Forget the failures so far."""
        self._left = self._most


def check_counts(num_envs: int, num_threads: int | None) -> None:
    """Check the numbers of environments and threads."""
    for count, what in ((num_envs, "environments"), (num_threads, "threads")):
        if count is not None and count < 1:
            raise InputError(f"the number of {what} is {count}: it must be at least 1")


def envs_at_once(task: Task, most: int, threads: int | None, retries: int) -> "Environments":
    """At most so many environments as there may be: one of a robot that exists once."""
    try:
        return Environments(task, most, threads, Retries(retries))
    except InputError:
        if most == 1 or is_batched(task):
            raise
    return Environments(task, 1, threads, Retries(retries))


def check_actions(actions: ArrayLike, num_envs: int, size: int) -> NDArray[np.float64]:
    """The actions as (num_envs, size) float64, all finite."""
    checked: NDArray[np.float64] = np.asarray(actions, dtype=np.float64)
    if checked.shape != (num_envs, size):
        raise InputError(
            f"actions have shape {checked.shape}: it must be ({num_envs}, {size}), one action for "
            "each environment"
        )
    if not math.isfinite(checked.sum()) and not np.isfinite(checked).all():
        raise NonFiniteActionError(f"actions are not finite: {checked.ravel()}")
    return checked


class Step(NamedTuple):
    """What a step of n environments led to; treat the arrays as read-only."""

    observation: Array  # (n, d) of the new states; the last one of its episode where that ended
    reward: Array  # (n,) 0 in an environment whose episode had ended before
    terminated: Flags  # (n,) true from the step on that ended the episode
    truncated: Flags  # (n,) likewise; also where the physics diverged


class Environments:
    """Environments of a task, n of them, each going through an episode at a time.

    An environment whose episode has ended stands still until it is reset. What one does depends on
    its own seed and actions alone, not on the number of environments or threads.

    Args:
        task: whose environment is made.
        num_envs: n.
        num_threads: threads to step a batch on; None takes one for each core.
        retries: of failures of separate environments, each of which ends an episode before the step
            that failed; by default none.

    Attributes:
        observation: the current one of each environment, (n, d) in physical units.
        arrays: the current ones of the task's `state` and `constants`, (n, width) each.
        info: all that a batch tells of its environments, by name, (n, ...) each.
        terminated, truncated: how each environment's episode has ended, (n,).
        active: whether it goes on, (n,); num_active: in how many environments it does.
        lost: whether the last step led to nothing that can be used, (n,): it doesn't count, and its
            episode ended before it, truncated.
        missing: readings that were missing in each environment's episode, (n,).
        instances: a batch, or one instance for each environment.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        num_threads: int | None = None,
        retries: Retries | None = None,
    ):
        check_counts(num_envs, num_threads)
        self.task, self.num_envs = task, num_envs
        if is_batched(task):
            if task.offset.any():
                raise InputError(f"{task.name} is stepped as a batch: its features have no offsets")
            self._batch: Any = make_batch(task, num_envs, num_threads)
            self.instances: Any = self._batch
        else:
            self._batch = Separate(task.whole, num_envs, retries or Retries())
            self.instances = self._batch.instances
        if task.domain:
            self._batch = Disturbed(self._batch, task, num_envs)
        if task.view:
            self._batch = ViewedBatch(self._batch, task, num_envs)
        self.lost = np.zeros(num_envs, np.bool_)
        self.missing: NDArray[np.int64] = getattr(
            self._batch, "missing", np.zeros(num_envs, np.int64)
        )
        self.observation = np.zeros((num_envs, task.size))
        self.arrays: Mapping[str, Array] = {}
        self.info: Mapping[str, Any] = {}
        self._names = tuple(task.arrays)
        self.terminated = self.truncated = np.ones(num_envs, dtype=np.bool_)
        self._count()
        self._seeds = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)

    @property
    def has_failed(self) -> bool:
        """Whether an environment failed in an episode of now, which ended early thereby."""
        return bool(np.any(getattr(self._batch, "failed", False)))

    @property
    def numbers(self) -> list[Numbers]:
        """What the last step of each told in `info`, see `Separate`; batches tell nothing."""
        return getattr(self._batch, "numbers", None) or [{} for _ in range(self.num_envs)]

    @property
    def steps(self) -> NDArray[np.int64]:
        """That each environment's episode has had so far, (n,)."""
        return self._steps.copy()

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> Array:
        """Start an episode in each of the environments, with its seed.

        Returns:
            The current observations of all environments, (n, d).
        """
        at = np.asarray(indices)
        self._seeds[at], self._steps[at] = seeds, 0
        self.terminated, self.truncated = self.terminated.copy(), self.truncated.copy()
        self.terminated[at] = self.truncated[at] = False
        self._count()
        given = dict(zip(indices, map(int, seeds), strict=True))
        every = [given.get(index) for index in range(self.num_envs)]
        mask = np.isin(np.arange(self.num_envs), indices)
        observation, info = self._batch.reset(seed=every, options={"reset_mask": mask})
        self._check(observation, np.zeros(self.num_envs), "reset gave")
        self.observation, self.info = observation, info
        self.arrays = {name: info[name] for name in self._names}
        return observation

    def step(self, actions: ArrayLike) -> Step:
        """Take one step in every environment whose episode goes on; actions (n, k)."""
        checked = check_actions(actions, self.num_envs, self.task.action_size)
        active = self.active
        self._steps += active
        observation, reward, terminated, truncated, info = self._batch.step(checked)
        arrays = {name: info[name] for name in self._names}
        if self.num_active < self.num_envs:
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
        return Step(observation, reward, terminated, truncated)

    def abandon(self) -> None:
        """Leave all episodes as if they had ended."""
        self.terminated = np.ones(self.num_envs, dtype=np.bool_)
        self._count()

    def close(self) -> None:
        """Free what the environments hold; a separate one is kept for the next who needs it."""
        self._batch.close()

    def __enter__(self) -> "Environments":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

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
        index = int(np.flatnonzero(~good)[0])
        raise EnvironmentFailedError(
            f"{self.task.name} {did} an observation or reward that is not finite, at step "
            f"{self._steps[index]} of the episode with seed {self._seeds[index]}"
        )


class _MissingError(Exception):
    """A reading is missing, before which the episode is to end."""


class Separate:
    """Separate instances, used like a batch: simulations of any kind, and real robots.

    Attributes:
        instances: the environments; None where one failed, until it is reset.
        lost, missing: as of `Environments`; after a lost step the observation is the one before it.
        failed: whether the environment failed in each environment's episode, (n,).
    """

    def __init__(self, task: Task, num_envs: int, retries: Retries):
        self._task, self._retries = task, [copy(retries) for _ in range(num_envs)]
        self.instances: list[Any] = []
        try:
            for _ in range(num_envs):
                self.instances.append(self._take())
        except BaseException:
            self.close()
            raise
        self._flat = flattener(self.instances[0].observation_space)
        self._action_space = self.instances[0].action_space
        self._offset = task.offset if task.offset.any() else None
        self._observation = np.zeros((num_envs, task.size))
        self._reward = np.zeros(num_envs)
        self._arrays = {name: np.zeros((num_envs, w)) for name, w in task.arrays.items()}
        self._infos: list[Mapping[str, Any]] = [{} for _ in range(num_envs)]
        self._succeeded = np.zeros(num_envs, np.bool_)  # at any step of the episode so far
        self._active = np.zeros(num_envs, np.bool_)
        self._seeds: list[int | None] = [0] * num_envs
        self._steps = np.zeros(num_envs, np.int64)  # of each episode, with the one under way
        self._last_reward = np.zeros(num_envs)  # of the episode under way
        self._held = np.zeros(num_envs, np.int64)  # steps in a row with missing readings
        self.missing = np.zeros(num_envs, np.int64)
        self.lost, self.failed = np.zeros((2, num_envs), np.bool_)

    def _take(self) -> Any:
        task = self._task
        domain = task.domain.physics if task.domain else None
        return take(task.id, task.arguments, task.max_episode_steps, domain)

    def reset(
        self, seed: Sequence[int | None], options: Mapping[str, Flags]
    ) -> tuple[Array, dict[str, Array]]:
        self._make_new_arrays()
        self._reward = self._reward.copy()
        for index in np.flatnonzero(options["reset_mask"]).tolist():
            self._begin(index, seed[index])
        return self._observation, self._arrays

    def _begin(self, index: int, seed: int | None) -> None:
        self._seeds[index], self._steps[index], self._active[index] = seed, 0, True
        while True:
            self._held[index] = self.missing[index] = self._last_reward[index] = 0
            self.failed[index] = False
            try:
                self.instances[index] = self.instances[index] or self._take()
                with isolated(), in_time():
                    observation, info = self.instances[index].reset(seed=seed)
                return self._put(index, observation, info)
            except OURS:
                raise
            except BaseException as error:
                self._handle_failure(index, error)

    def step(self, actions: Array) -> tuple[Array, Array, Flags, Flags, dict[str, Array]]:
        chosen = self._active.copy()
        self._make_new_arrays()
        self._reward, self.lost = np.zeros(len(chosen)), np.zeros(len(chosen), np.bool_)
        single = actions.astype(np.float32)
        terminated, truncated = np.zeros((2, len(chosen)), np.bool_)
        timed = in_time if STEP_TIMEOUT in os.environ else nullcontext  # which costs less
        with isolated(in_episode=True):
            for index in np.flatnonzero(chosen).tolist():
                self._steps[index] += 1
                try:
                    with timed():
                        ends = self._step(index, single[index])
                    terminated[index], truncated[index] = ends
                except _MissingError:
                    self._lose(index)
                except OURS:
                    raise
                except BaseException as error:
                    self._handle_failure(index, error)
                    self._lose(index)
                    self.failed[index] = True
                truncated[index] |= self.lost[index]
                self._active[index] = not (terminated[index] or truncated[index])
                if not (self._active[index] or self.lost[index]):
                    self._retries[index].succeeded()
        return self._observation, self._reward, terminated, truncated, self._arrays

    def _step(self, index: int, action: NDArray[np.float32]) -> tuple[bool, bool]:
        own = action_in(self._action_space, action)  # which the environment may change
        observation, reward, terminated, truncated, info = self.instances[index].step(own)
        ends = number(terminated, "terminated"), number(truncated, "truncated")
        if math.isnan(sum(ends)):
            raise ValueError("it gave a terminated or truncated that is not a number")
        self._put(index, observation, info, number(reward, "reward"), True)
        return bool(ends[0]), bool(ends[1])

    def _make_new_arrays(self) -> None:
        """So that those given before don't change."""
        self._observation = self._observation.copy()
        if self._arrays:
            self._arrays = {name: values.copy() for name, values in self._arrays.items()}

    def _put(
        self,
        index: int,
        observation: Any,
        info: Mapping[str, Any],
        reward: float = 0.0,
        after_step: bool = False,
    ) -> None:
        flat = of_size(self._flat(observation), self._task.size)
        if self._offset is not None:
            flat = flat - self._offset
        if float(np.abs(flat).sum()) + abs(reward) <= _LARGEST:
            self._held[index] = 0
        else:
            flat, reward = self._without_missing(index, flat, reward, after_step)
        self._observation[index] = flat
        self._reward[index] = self._last_reward[index] = reward
        for name, values in self._arrays.items():
            values[index] = info[name]
        info = info or {}
        self._infos[index] = info
        self._succeeded[index] &= after_step
        self._succeeded[index] |= after_step and bool(number_of(info.get(SUCCESS)))

    def _without_missing(
        self, index: int, flat: Array, reward: float, after_step: bool
    ) -> tuple[Array, float]:
        """An observation and a reward in which the last ones stand for those that are missing."""
        missing, is_missing = ~(np.abs(flat) <= _LARGEST), not abs(reward) <= _LARGEST
        if not missing.any() and not is_missing:
            return flat, reward  # their sum is larger
        self.missing[index] += missing.sum() + is_missing
        self._held[index] += 1
        if self._task.missing == "skip" and self._steps[index] > 1:
            raise _MissingError
        if not after_step or self._held[index] > most_held(self._task.missing or ""):
            fix = "`missing` says what to do, such as hold:3, or skip if it isn't in the first step"
            if self._task.missing == "skip":
                fix = "skip can't leave out a first step; hold:3 repeats the last readings"
            if most := most_held(self._task.missing or ""):
                fix = f"no more than {most} steps in a row may be"
            raise EnvironmentFailedError(
                f"{self._task.name} {'gave' if after_step else 'reset gave'} an observation or "
                f"reward that is not finite in 32 bits, {self._where(index)}: "
                f"{fix if after_step else 'an episode must begin with all of them'}"
            )
        filled = np.where(missing, self._observation[index], flat)
        return filled, self._last_reward[index] if is_missing else reward

    def _where(self, index: int) -> str:
        return f"at step {self._steps[index]} of the episode with seed {self._seeds[index]}"

    def _lose(self, index: int) -> None:
        """Let the episode of an environment end before the step that it just took."""
        self.lost[index], self._reward[index] = True, 0.0
        self._steps[index] -= 1

    def _handle_failure(self, index: int, error: BaseException) -> None:
        """Go on after a failure, unless there were too many, with a new instance."""
        if self.instances[index] is not None:
            discard(self.instances[index])
            self.instances[index] = None
        if not isinstance(error, EnvironmentFailedError):
            error = EnvironmentFailedError(
                f"{self._task.name} failed {self._where(index)}: {kind_and_line(error)}"
            )
        self._retries[index].failed(error)

    @property
    def numbers(self) -> list[Numbers]:
        """What each one's last step told in `info`; `is_success` if any step of its episode did.

        An environment may go on after a success, so its last step alone would miss some.
        """
        pairs = zip(self._infos, self._succeeded.tolist(), strict=True)
        return [numbers_in(info) | ({SUCCESS: 1.0} if won else {}) for info, won in pairs]

    def close(self) -> None:
        """Give the environments back."""
        for env in self.instances:
            if env is not None:
                give_back(env)
