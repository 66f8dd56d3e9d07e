"""Environments with autoreset: where an episode ends, the same step begins the next one."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.environments import Environments, Flags, Retries, State, Step
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError


class AutoresetStep(NamedTuple):
    """What an action in each of n environments led to."""

    observation: Array  # (n, d); the first of the next episode where one ended
    final: Array  # (n, d); the last one of the episode that ended, else the same
    reward: Array  # (n,), the sum while the action was held
    length: NDArray[np.int64]  # (n,) steps of the episode so far, or of the one that ended
    ended: Flags  # (n,)
    terminated: Flags  # (n,) whether a state ended it
    non_finite: Flags | None  # (n,) whether the physics diverged, where the environment says so

    def end_info(self, index: int) -> dict[str, Any]:
        """What there is to say of the end of an episode, some of it by its environment."""
        info: dict[str, Any] = {"control_steps": int(self.length[index])}
        if self.non_finite is not None:
            info["non_finite"] = bool(self.non_finite[index])
        return info


class AutoresetEnvironments:
    """Environments whose episodes follow one another.

    An environment's first episode has its seed, as Gymnasium has it; episode k from 1
    on has a number below 2^31 drawn from that seed and k, so that each can be played again by
    itself.

    Args:
        repeat: steps for which each action is held; fewer where an episode ends before.
        retries: of failures, which truncate episodes; a failed step has the reward before it.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        num_threads: int | None = None,
        repeat: int = 1,
        retries: int = 0,
    ):
        if repeat < 1:
            raise InputError(f"the action repeat is {repeat}: it must be at least 1")
        self.envs = Environments(task, num_envs, num_threads, Retries(retries))
        self._repeat, self._size = repeat, task.action_size
        self._seeds = np.zeros(num_envs, np.int64)
        self._episodes = np.zeros(num_envs, np.int64)  # k of each environment's episode
        self._taken: list[Array] = []  # actions since the oldest episode of now began, (n, k) each
        self._begun = np.zeros(num_envs, np.int64)  # how many of them came before each episode
        self._reward = np.zeros(num_envs)  # of the last step

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Start the first episode of each new seed, or the next one; observations (n, d)."""
        self._episodes += 1
        for index, seed in enumerate(seeds):
            if seed is not None:
                self._seeds[index], self._episodes[index] = seed, 0
        return self._start(range(self.envs.num_envs))

    def restart(self) -> Array:
        """Start the episodes of now once more, as after others were played instead."""
        return self._start(range(self.envs.num_envs))

    def step(self, actions: Array) -> AutoresetStep:
        """Hold an action in every environment for its steps; actions (n, k)."""
        if not self.envs.num_active:
            raise InputError("no episode has begun: reset the environments first")
        self._taken.append(actions)
        step, reward, non_finite = self._hold(actions)
        ended, observation, length = ~self.envs.active, step.observation, self.envs.steps
        if ended.any():
            numbers = np.flatnonzero(ended).tolist()
            self._episodes[numbers] += 1
            observation = self._start(numbers)
        final, terminated = step.observation, step.terminated
        return AutoresetStep(observation, final, reward, length, ended, terminated, non_finite)

    def _hold(self, actions: Array) -> tuple[Step, Array, Flags | None]:
        """The last step, the sum of rewards, and whether the physics diverged in any."""
        envs, total, diverged = self.envs, np.zeros(self.envs.num_envs), None
        for _ in range(self._repeat):
            active = envs.active
            step = envs.step(actions)
            self._reward = np.where(envs.lost, self._reward, step.reward)
            total += self._reward
            if (now := envs.info.get("non_finite")) is not None:
                diverged = now if diverged is None else np.where(active, now, diverged)
            if not envs.num_active:
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
            "observation": self.envs.observation.copy(),
        }

    def restore(self, state: State) -> None:
        """Play the episodes of a state again, to the same bits, and continue from there."""
        self._seeds, self._episodes = state["first_seeds"].copy(), state["episodes"].copy()
        actions, begun = state["actions"], state["begun"].copy()
        self.envs.abandon()
        for number in range(len(actions) + 1):
            if len(begin := np.flatnonzero(begun == number)):
                self.envs.reset(begin.tolist(), self._seeds_of(begin.tolist()))
            if number < len(actions):
                self._hold(actions[number])
        self._taken, self._begun = [*actions], begun
        if self.envs.observation.tobytes() != state["observation"].tobytes():
            raise InputError(
                f"{self.envs.task.name} is not reproducible here, or another than it was: the "
                "same seed and actions lead to another state, so this can't continue where it "
                "stopped"
            )

    def _start(self, indices: Sequence[int]) -> Array:
        self._begun[indices], self._reward[indices] = len(self._taken), 0.0
        oldest = int(self._begun.min())
        del self._taken[:oldest]
        self._begun -= oldest
        return self.envs.reset(indices, self._seeds_of(indices))

    def _seeds_of(self, indices: Sequence[int]) -> list[int]:
        return [_episode_seed(int(self._seeds[i]), int(self._episodes[i])) for i in indices]


def _episode_seed(first: int, episode: int) -> int:
    if episode == 0:
        return first
    return int(np.random.SeedSequence([first, episode]).generate_state(1)[0]) >> 1
