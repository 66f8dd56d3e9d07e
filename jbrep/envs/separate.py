"""An environment for each lane, used like a batch: simulations of any kind, and real robots."""

import warnings
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.envs import instances
from jbrep.envs.infos import SUCCESS, Numbers, number_of, numbers_in
from jbrep.envs.make import action_in, aside, flattener, number, of_size
from jbrep.envs.task import Array, Task, most_held
from jbrep.errors import InputError, Notice, kind_and_line

Flags = NDArray[np.bool_]
State = dict[str, NDArray[Any]]
_LARGEST = float(np.finfo(np.float32).max)  # that data sets and agents can have


class EnvironmentFailedError(InputError):
    """An environment raised an error, or gave something else than its task's description says."""


class Retries:
    """How often what fails is tried again, in a row."""

    def __init__(self, most: int = 0):
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


class _MissingError(Exception):
    """A reading is missing, before which the episode is to end."""


class Separate:
    """An environment for each lane.

    Args:
        task: whose environments are made.
        num_lanes: how many.
        retries: of failures, which end an episode before the step that failed.

    Attributes:
        envs: the environments; None where one failed, until the lane is reset.
        lost: whether the last step of each lane led to nothing that can be used, (n,): the
            observation is still the one before it, and the episode is truncated.
        metadata: what the environments say of themselves.
        failed: whether the environment failed in each lane's episode, (n,).
        missing: readings that were missing in each lane's episode, (n,).
    """

    def __init__(self, task: Task, num_lanes: int, retries: Retries):
        self._task, self._retries = task, [copy(retries) for _ in range(num_lanes)]
        self.envs: list[Any] = []
        try:
            for _ in range(num_lanes):
                self.envs.append(self._take())
        except BaseException:
            self.close()
            raise
        self.metadata: Mapping[str, Any] = self.envs[0].metadata
        self._flat = flattener(self.envs[0].observation_space)
        self._action_space = self.envs[0].action_space
        self._offset = task.offset if task.offset.any() else None
        self._observation = np.zeros((num_lanes, task.size))
        self._reward = np.zeros(num_lanes)
        self._arrays = {name: np.zeros((num_lanes, w)) for name, w in task.arrays.items()}
        self._infos: list[Mapping[str, Any]] = [{} for _ in range(num_lanes)]
        self._succeeded = np.zeros(num_lanes, np.bool_)  # at any step of the episode so far
        self._active = np.zeros(num_lanes, np.bool_)
        self._seeds: list[int | None] = [0] * num_lanes
        self._steps = np.zeros(num_lanes, np.int64)  # of each episode, with the one under way
        self._last_reward = np.zeros(num_lanes)  # of the episode under way
        self._held = np.zeros(num_lanes, np.int64)  # steps in a row with missing readings
        self.missing = np.zeros(num_lanes, np.int64)
        self.lost, self.failed = np.zeros((2, num_lanes), np.bool_)

    def _take(self) -> Any:
        task = self._task
        domain = task.domain.physics if task.domain else None
        return instances.take(task.id, task.arguments, task.max_episode_steps, domain)

    def reset(
        self, seed: Sequence[int | None], options: Mapping[str, Flags]
    ) -> tuple[Array, dict[str, Array]]:
        self._make_new_arrays()
        for lane in np.flatnonzero(options["reset_mask"]).tolist():
            self._begin(lane, seed[lane])
        return self._observation, self._arrays

    def _begin(self, lane: int, seed: int | None) -> None:
        """Begin an episode, if need be with another instance."""
        self._seeds[lane], self._steps[lane], self._active[lane] = seed, 0, True
        while True:
            self._held[lane] = self.missing[lane] = self._last_reward[lane] = 0
            self.failed[lane] = False
            try:
                self.envs[lane] = self.envs[lane] or self._take()
                with aside():
                    observation, info = self.envs[lane].reset(seed=seed)
                return self._put(lane, observation, info)
            except Exception as error:
                self._handle_failure(lane, error)

    def step(self, actions: Array) -> tuple[Array, Array, Flags, Flags, dict[str, Array]]:
        chosen = self._active.copy()
        self._make_new_arrays()
        self._reward, self.lost = np.zeros(len(chosen)), np.zeros(len(chosen), np.bool_)
        single = actions.astype(np.float32)
        terminated, truncated = np.zeros((2, len(chosen)), np.bool_)
        with aside():
            for lane in np.flatnonzero(chosen).tolist():
                self._steps[lane] += 1
                try:
                    terminated[lane], truncated[lane] = self._step(lane, single[lane])
                except _MissingError:
                    self._lose(lane)
                except Exception as error:
                    self._handle_failure(lane, error)
                    self._lose(lane)
                    self.failed[lane] = True
                truncated[lane] |= self.lost[lane]
                self._active[lane] = not (terminated[lane] or truncated[lane])
                if not (self._active[lane] or self.lost[lane]):
                    self._retries[lane].succeeded()
        return self._observation, self._reward, terminated, truncated, self._arrays

    def _step(self, lane: int, action: NDArray[np.float32]) -> tuple[bool, bool]:
        """Step a lane; whether its episode is terminated and truncated."""
        own = action_in(self._action_space, action)  # which the environment may change
        observation, reward, terminated, truncated, info = self.envs[lane].step(own)
        ends = number(terminated, "terminated"), number(truncated, "truncated")
        self._put(lane, observation, info, number(reward, "reward"), True)
        return bool(ends[0]), bool(ends[1])

    def _make_new_arrays(self) -> None:
        """So that those given before don't change."""
        self._observation = self._observation.copy()
        if self._arrays:
            self._arrays = {name: values.copy() for name, values in self._arrays.items()}

    def _put(
        self,
        lane: int,
        observation: Any,
        info: Mapping[str, Any],
        reward: float = 0.0,
        after_step: bool = False,
    ) -> None:
        flat = of_size(self._flat(observation), self._task.size)
        if self._offset is not None:
            flat = flat - self._offset
        if float(np.abs(flat).sum()) + abs(reward) <= _LARGEST:
            self._held[lane] = 0
        else:
            flat, reward = self._without_missing(lane, flat, reward, after_step)
        self._observation[lane] = flat
        self._reward[lane] = self._last_reward[lane] = reward
        for name, values in self._arrays.items():
            values[lane] = info[name]
        info = info or {}
        self._infos[lane] = info
        self._succeeded[lane] &= after_step
        self._succeeded[lane] |= after_step and bool(number_of(info.get(SUCCESS)))

    def _without_missing(
        self, lane: int, flat: Array, reward: float, after_step: bool
    ) -> tuple[Array, float]:
        """An observation and a reward in which the last ones stand for those that are missing."""
        missing, is_missing = ~(np.abs(flat) <= _LARGEST), not abs(reward) <= _LARGEST
        if not missing.any() and not is_missing:
            return flat, reward  # their sum is larger
        self.missing[lane] += missing.sum() + is_missing
        self._held[lane] += 1
        if self._task.missing == "skip" and self._steps[lane] > 1:
            raise _MissingError
        if not after_step or self._held[lane] > most_held(self._task.missing or ""):
            raise EnvironmentFailedError(
                f"{self._task.name} {'gave' if after_step else 'reset gave'} an observation or "
                f"reward that is not finite in 32 bits, {self._where(lane)}; {self._missing_said}"
            )
        filled = np.where(missing, self._observation[lane], flat)
        return filled, self._last_reward[lane] if is_missing else reward

    @property
    def _missing_said(self) -> str:
        missing = self._task.missing
        if missing == "skip":
            return "no episode can end before its first step: give --missing hold:1, or more"
        return f"that is beyond --missing {missing}" if missing else "--missing says what to do"

    def _where(self, lane: int) -> str:
        return f"at step {self._steps[lane]} of the episode with seed {self._seeds[lane]}"

    def _lose(self, lane: int) -> None:
        """Let the episode of a lane end before the step that it just took."""
        self.lost[lane], self._reward[lane] = True, 0.0
        self._steps[lane] -= 1

    def _handle_failure(self, lane: int, error: Exception) -> None:
        """Go on after a failure, unless there were too many, with a new instance."""
        if self.envs[lane] is not None:
            instances.discard(self.envs[lane])
            self.envs[lane] = None
        if not isinstance(error, EnvironmentFailedError):
            error = EnvironmentFailedError(
                f"{self._task.name} failed {self._where(lane)}: {kind_and_line(error)}"
            )
        self._retries[lane].failed(error)

    def render(self) -> tuple[Any, ...]:
        with aside():
            return tuple(env.render() for env in self.envs)

    @property
    def numbers(self) -> list[Numbers]:
        """What each lane's last step told in `info`; `is_success` if any step of its episode did.

        An environment may go on after a success, so its last step alone would miss some.
        """
        told = zip(self._infos, self._succeeded.tolist(), strict=True)
        return [numbers_in(info) | ({SUCCESS: 1.0} if won else {}) for info, won in told]

    def close(self) -> None:
        """Give the environments back."""
        for env in self.envs:
            if env is not None:
                instances.give_back(env)
