"""Lanes with autoreset: where an episode ends, the same step begins the next one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.lanes import Flags, Lanes, Retries, State, Step
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError


class AutoresetStep(NamedTuple):
    """What an action in each of n lanes led to."""

    observation: Array  # (n, d); the first of the next episode where one ended
    final: Array  # (n, d); the last one of the episode that ended, else the same
    reward: Array  # (n,), the sum while the action was held
    length: NDArray[np.int64]  # (n,) steps of the episode so far, or of the one that ended
    ended: Flags  # (n,)
    terminated: Flags  # (n,) whether a state ended it
    non_finite: Flags | None  # (n,) whether the physics diverged, where the environment says so
    lost: Flags  # (n,) whether it led to nothing, as the environment failed at once

    @property
    def diverged(self) -> Flags:
        """Whether the physics is known to have diverged, (n,)."""
        return np.zeros_like(self.ended) if self.non_finite is None else self.non_finite

    def told(self, lane: int) -> dict[str, Any]:
        """What there is to say of the end of a lane's episode, some of it by its environment."""
        told: dict[str, Any] = {"control_steps": int(self.length[lane])}
        if self.non_finite is not None:
            told["non_finite"] = bool(self.non_finite[lane])
        return told


class AutoresetLanes:
    """Lanes whose episodes follow one another.

    The first episode of a lane has the lane's seed, as in a Gymnasium environment; episode k from 1
    on has a number below 2^31 drawn from that seed and k, so that each can be played again by
    itself.

    Args:
        task: whose environment is made.
        num_lanes: n.
        num_threads: as for `Lanes`.
        repeat: steps for which each action is held; fewer where an episode ends before.
        retries: of failures, each of which ends an episode, truncated, before the step that failed.

    Attributes:
        lanes: the episodes under way.
    """

    def __init__(
        self,
        task: Task,
        num_lanes: int,
        num_threads: int | None = None,
        repeat: int = 1,
        retries: int = 0,
    ):
        if repeat < 1:
            raise InputError(f"the action repeat is {repeat}: it must be at least 1")
        self.lanes = Lanes(task, num_lanes, num_threads, Retries(retries))
        self._repeat = repeat
        self._seeds = np.zeros(num_lanes, np.int64)
        self._episodes = np.zeros(num_lanes, np.int64)  # k of each lane's episode

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Start the first episode of a lane's new seed, or its next one; observations (n, d)."""
        self._episodes += 1
        for lane, seed in enumerate(seeds):
            if seed is not None:
                self._seeds[lane], self._episodes[lane] = seed, 0
        return self._start(range(self.lanes.num_lanes))

    def restart(self) -> Array:
        """Start the episodes of now once more, as after others were played in their lanes."""
        return self._start(range(self.lanes.num_lanes))

    def step(self, actions: Array) -> AutoresetStep:
        """Hold an action in every lane for its steps; actions (n, k)."""
        before = self.lanes.steps
        step, reward, non_finite = self._hold(actions)
        lost = self.lanes.steps == before
        ended, observation, length = ~self.lanes.active, step.observation, self.lanes.steps
        if ended.any():
            numbers = np.flatnonzero(ended).tolist()
            self._episodes[numbers] += 1
            observation = self._start(numbers)
        final, terminated = step.observation, step.terminated
        return AutoresetStep(
            observation, final, reward, length, ended, terminated, non_finite, lost
        )

    def _hold(self, actions: Array) -> tuple[Step, Array, Flags | None]:
        """The last step, the sum of rewards, and whether the physics diverged in any."""
        lanes, total, diverged = self.lanes, np.zeros(self.lanes.num_lanes), None
        for _ in range(self._repeat):
            active = lanes.active
            step = lanes.step(actions)
            total += step.reward
            if (now := lanes.info.get("non_finite")) is not None:
                diverged = now if diverged is None else np.where(active, now, diverged)
            if not lanes.num_active:
                break
        return step, total, diverged

    @property
    def state(self) -> State:
        own = {"first_seeds": self._seeds.copy(), "episodes": self._episodes.copy()}
        return own | self.lanes.state

    def restore(self, state: State) -> None:
        lanes = dict(state)
        self._seeds = lanes.pop("first_seeds").copy()
        self._episodes = lanes.pop("episodes").copy()
        self.lanes.restore(lanes)

    def _start(self, lanes: Sequence[int]) -> Array:
        seeds = [_episode_seed(int(self._seeds[i]), int(self._episodes[i])) for i in lanes]
        return self.lanes.reset(lanes, seeds)


def _episode_seed(first: int, episode: int) -> int:
    """The seed of a lane's episode, from that of its first and the number of episodes before."""
    if episode == 0:
        return first
    return int(np.random.SeedSequence([first, episode]).generate_state(1)[0]) >> 1
