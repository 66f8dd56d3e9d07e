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
        repeat: steps for which each action is held; fewer where an episode ends before.
        retries: of failures, each of which ends an episode, truncated, before the step that failed.
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
        self._repeat, self._size = repeat, task.action_size
        self._seeds = np.zeros(num_lanes, np.int64)
        self._episodes = np.zeros(num_lanes, np.int64)  # k of each lane's episode
        self._taken: list[Array] = []  # actions since the oldest episode of now began, (n, k) each
        self._begun = np.zeros(num_lanes, np.int64)  # how many of them came before each episode

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
        self._taken.append(actions)
        step, reward, non_finite = self._hold(actions)
        ended, observation, length = ~self.lanes.active, step.observation, self.lanes.steps
        if ended.any():
            numbers = np.flatnonzero(ended).tolist()
            self._episodes[numbers] += 1
            observation = self._start(numbers)
        final, terminated = step.observation, step.terminated
        return AutoresetStep(observation, final, reward, length, ended, terminated, non_finite)

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
        """What `restore` takes: the episodes of now, by their seeds and actions."""
        return {
            "first_seeds": self._seeds.copy(),
            "episodes": self._episodes.copy(),
            "begun": self._begun.copy(),
            "actions": np.array(self._taken).reshape(-1, *self._begun.shape, self._size),
            "observation": self.lanes.observation.copy(),
        }

    def restore(self, state: State) -> None:
        """Play the episodes of a state again, to the same bits, and continue from there."""
        self._seeds, self._episodes = state["first_seeds"].copy(), state["episodes"].copy()
        actions, begun = state["actions"], state["begun"].copy()
        self.lanes.abandon()
        for number in range(len(actions) + 1):
            if len(begin := np.flatnonzero(begun == number)):
                self.lanes.reset(begin.tolist(), self._seeds_of(begin.tolist()))
            if number < len(actions):
                self._hold(actions[number])
        self._taken, self._begun = [*actions], begun
        if self.lanes.observation.tobytes() != state["observation"].tobytes():
            raise InputError(
                f"{self.lanes.task.name} is not reproducible here, or another than it was: the "
                "same seed and actions lead to another state, so this can't continue where it "
                "stopped"
            )

    def _start(self, lanes: Sequence[int]) -> Array:
        self._begun[lanes] = len(self._taken)
        oldest = int(self._begun.min())
        del self._taken[:oldest]
        self._begun -= oldest
        return self.lanes.reset(lanes, self._seeds_of(lanes))

    def _seeds_of(self, lanes: Sequence[int]) -> list[int]:
        return [_episode_seed(int(self._seeds[i]), int(self._episodes[i])) for i in lanes]


def _episode_seed(first: int, episode: int) -> int:
    if episode == 0:
        return first
    return int(np.random.SeedSequence([first, episode]).generate_state(1)[0]) >> 1
