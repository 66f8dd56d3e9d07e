"""Lanes: many environments of one task, each reset with a seed of its own and stepped together."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.make import flattener, is_batched, make_batch, make_env
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, kind_and_line

Flags = NDArray[np.bool_]
State = dict[str, NDArray[Any]]  # everything that decides how lanes continue; (n, ...) each


class NonFiniteActionError(InputError):
    """An action is NaN or infinite."""


class EnvironmentFailedError(InputError):
    """An environment raised an error, or gave something else than its task's description says.

    Attributes:
        lane: in which it did.
    """

    def __init__(self, message: str, lane: int):
        super().__init__(message)
        self.lane = lane


def check_counts(num_lanes: int, num_threads: int | None) -> None:
    """Check the numbers of lanes and threads.

    Raises:
        InputError: a number below 1.
    """
    for count, what in ((num_lanes, "lanes"), (num_threads, "threads")):
        if count is not None and count < 1:
            raise InputError(f"the number of {what} is {count}: it must be at least 1")


def check_actions(actions: ArrayLike, num_lanes: int, size: int) -> NDArray[np.float64]:
    """The actions as (num_lanes, size) float64.

    Raises:
        InputError: another shape.
        NonFiniteActionError: a value that is not finite.
    """
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

    Attributes:
        task: the task.
        num_lanes: n.
        observation: the current one of each lane, (n, d) in physical units.
        arrays: the current ones of the task's `state` and `constants`, (n, width) each.
        info: all that a batch tells of its lanes, by name, (n, ...) each.
        terminated, truncated: how each lane's episode has ended, (n,).
        active: whether it goes on, (n,).
        num_active: in how many lanes it does.
        envs: the environments themselves: a batch, or one for each lane.

    Raises:
        InputError: a number below 1, or the environment can't be made.
    """

    def __init__(self, task: Task, num_lanes: int, num_threads: int | None = None):
        check_counts(num_lanes, num_threads)
        self.task, self.num_lanes = task, num_lanes
        if is_batched(task):
            self._batch: Any = make_batch(task, num_lanes, num_threads)
            self.envs: Any = self._batch
        else:
            self._batch = _Separate(task, num_lanes)
            self.envs = self._batch.envs
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
    def ended(self) -> Flags:
        """Whether each lane's episode has ended, (n,)."""
        return ~self.active

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
        """Take one step in every lane whose episode goes on.

        Raises:
            InputError: actions of another shape than (n, k).
            NonFiniteActionError: actions that are not finite.
            EnvironmentFailedError: the environment raises an error, or gives a number that isn't
                finite; the message has the lane's seed and step.
        """
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
        self._count()
        return Step(observation, reward, terminated, truncated, arrays)

    @property
    def state(self) -> State:
        """A copy of what `restore` takes."""
        own = {
            "seeds": self._seeds.copy(),
            "steps": self._steps.copy(),
            "terminated": self.terminated.copy(),
            "truncated": self.truncated.copy(),
            "observation": self.observation.copy(),
        }
        return own | self._batch.state

    def restore(self, state: State) -> None:
        """Continue from where the state was taken, to the same bits.

        Raises:
            InputError: the environment isn't reproducible.
        """
        batch = dict(state)
        self._seeds, self._steps = batch.pop("seeds").copy(), batch.pop("steps").copy()
        self.terminated, self.truncated = batch.pop("terminated"), batch.pop("truncated")
        self._count()
        expected = batch.pop("observation")
        observation, info = self._batch.restore(batch)
        observation = np.where(self.active[:, None], observation, expected)
        if observation.tobytes() != expected.astype(np.float64).tobytes():
            raise InputError(
                f"{self.task.name} is not reproducible here: the same seed and actions lead to "
                "another state, so this can't continue where it stopped"
            )
        self._see(observation, info)

    def close(self) -> None:
        """Free what the environments hold."""
        self._batch.close()

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
            f"{self._steps[lane]} of the episode with seed {self._seeds[lane]}",
            lane,
        )


class _Separate:
    """An environment for each lane, used like a batch without resets of its own.

    A lane's state is its seed and the actions since.
    """

    def __init__(self, task: Task, num_lanes: int):
        self._task = task
        self.envs: Any = [
            make_env(task.id, task.arguments, task.max_episode_steps) for _ in range(num_lanes)
        ]
        self._flat = flattener(self.envs[0].observation_space)
        space: Any = self.envs[0].action_space
        self._action_type, self._action_shape = space.dtype, space.shape
        self._observation = np.zeros((num_lanes, task.size))
        self._arrays = {name: np.zeros((num_lanes, w)) for name, w in task.arrays.items()}
        self._seeds: list[int | None] = [0] * num_lanes
        self._active = np.zeros(num_lanes, np.bool_)
        self._actions: list[list[NDArray[np.float32]]] = [[] for _ in range(num_lanes)]

    def reset(
        self, seed: Sequence[int | None], options: Mapping[str, Flags]
    ) -> tuple[Array, dict[str, Array]]:
        self._make_new_arrays()
        for lane in np.flatnonzero(options["reset_mask"]).tolist():
            self._seeds[lane], self._actions[lane], self._active[lane] = seed[lane], [], True
            try:
                observation, info = self.envs[lane].reset(seed=seed[lane])
                self._put(lane, observation, info)
            except Exception as error:
                raise self._failure(lane, error) from error
        return self._observation, self._arrays

    def step(self, actions: Array) -> tuple[Array, Array, Flags, Flags, dict[str, Array]]:
        return self._advance(actions, self._active)

    def _advance(
        self, actions: Array, chosen: Flags
    ) -> tuple[Array, Array, Flags, Flags, dict[str, Array]]:
        """Step the lanes that are chosen."""
        self._make_new_arrays()
        single, reward = actions.astype(np.float32), np.zeros(len(chosen))
        terminated, truncated = np.zeros((2, len(chosen)), np.bool_)
        for lane in np.flatnonzero(chosen).tolist():
            self._actions[lane].append(single[lane])
            action = single[lane].astype(self._action_type, copy=False).reshape(self._action_shape)
            try:
                observation, *result, info = self.envs[lane].step(action)
                self._put(lane, observation, info)
                reward[lane], terminated[lane], truncated[lane] = result
            except Exception as error:
                raise self._failure(lane, error) from error
            self._active[lane] = not (terminated[lane] or truncated[lane])
        return self._observation, reward, terminated, truncated, self._arrays

    def _make_new_arrays(self) -> None:
        """So that those given before don't change."""
        self._observation = self._observation.copy()
        if self._arrays:
            self._arrays = {name: values.copy() for name, values in self._arrays.items()}

    def _put(self, lane: int, observation: Any, info: Mapping[str, Any]) -> None:
        flat = self._flat(observation)
        if flat.shape != (self._task.size,):
            raise ValueError(
                f"it gave an observation of {flat.size} numbers instead of {self._task.size}"
            )
        self._observation[lane] = flat
        for name, values in self._arrays.items():
            values[lane] = info[name]

    def _failure(self, lane: int, error: Exception) -> EnvironmentFailedError:
        return EnvironmentFailedError(
            f"{self._task.name} failed at step {len(self._actions[lane])} of the episode with seed "
            f"{self._seeds[lane]}: {kind_and_line(error)}",
            lane,
        )

    @property
    def state(self) -> State:
        lengths = [len(actions) for actions in self._actions]
        taken = np.zeros((len(self.envs), max(lengths), self._task.action_size), np.float32)
        for lane, actions in enumerate(self._actions):
            taken[lane, : len(actions)] = actions or 0
        return {
            "episode_seeds": np.array(self._seeds),
            "lengths": np.array(lengths),
            "actions": taken,
        }

    def restore(self, state: State) -> tuple[Array, dict[str, Array]]:
        lengths, every_lane = state["lengths"], np.ones(len(self.envs), np.bool_)
        self.reset(state["episode_seeds"].tolist(), {"reset_mask": every_lane})
        for step in range(max(lengths.tolist())):
            self._advance(state["actions"][:, step], step < lengths)
        return self._observation, self._arrays

    def close(self) -> None:
        for env in self.envs:
            env.close()
