"""Episodes on many lanes: seeds, time limit, and reset in the step that ends an episode."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation, check_actions
from jbrep.jitterbug.tasks import EPISODE_STEPS, Array, get_task


class Outcome(NamedTuple):
    """What a step gave in each of n lanes; the arrays are to be read, not written."""

    observation: Array  # (n, d) the next episode's first where one ended
    reward: Array  # (n,) 0 where the physics diverged
    done: NDArray[np.bool_]  # (n,)
    ended: list[int]  # the lanes where done
    diverged: NDArray[np.bool_]  # (n,)
    final_observation: Array  # (n, d) before any reset; the last finite one where it diverged


class Episodes:
    """Endless episodes of a task in n lanes, each lane with a generator of its own.

    An episode ends at the time limit or when its physics diverges. Neither is the robot's doing,
    so both truncate and none terminates.

    Raises:
        InputError: unknown task, or a number below 1.
    """

    def __init__(
        self,
        task: str,
        num_envs: int,
        num_threads: int | None = None,
        max_episode_steps: int = EPISODE_STEPS,
    ):
        if max_episode_steps < 1:
            raise InputError(
                f"the number of steps in an episode is {max_episode_steps}: it must be at least 1"
            )
        self.task = get_task(task)
        self.simulation = Simulation(self.task, num_envs, num_threads)
        self._max_steps = max_episode_steps
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._randoms = [np.random.default_rng() for _ in range(num_envs)]
        self._observation = np.zeros((num_envs, self.task.size))

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Start anew in every lane; a seed of None goes on with the lane's generator."""
        for lane, seed in enumerate(seeds):
            if seed is not None:
                self._randoms[lane] = np.random.default_rng(seed)
        self._restart(range(self.simulation.num_lanes))
        return self._observation

    def step(self, actions: ArrayLike) -> Outcome:
        """One control step in every lane.

        Raises:
            InputError: actions of another shape than (n, 1), or not finite.
        """
        diverged = self.simulation.step(check_actions(actions, self.simulation.num_lanes))
        reward, observation = self.simulation.reward(), self.simulation.observe()
        self._steps += 1
        done = diverged | (self._steps >= self._max_steps)
        ended: list[int] = done.nonzero()[0].tolist()
        if ended:
            reward[diverged] = 0
            observation[diverged] = self._observation[diverged]
        self._observation = observation
        if ended:
            self._restart(ended)
        return Outcome(self._observation, reward, done, ended, diverged, observation)

    @property
    def state(self) -> tuple[dict[str, Array], list[Any]]:
        """What `restore` takes: arrays by name, (n, ...) each, and the generators' states."""
        arrays = {**self.simulation.state, "observation": self._observation.copy()}
        arrays["steps"] = self._steps.astype(np.float64)
        generators = [random.bit_generator.state for random in self._randoms]
        return arrays, generators

    def restore(self, arrays: Mapping[str, Array], generators: Sequence[Any]) -> None:
        """Go on from where `state` was taken, bit for bit."""
        physics = dict(arrays)
        self._steps[:] = physics.pop("steps")
        self._observation = physics.pop("observation").copy()
        for random, state in zip(self._randoms, generators, strict=True):
            random.bit_generator.state = state
        self.simulation.restore(**physics)

    def _restart(self, lanes: Sequence[int]) -> None:
        self.simulation.reset(lanes, [self._randoms[lane] for lane in lanes])
        self._steps[lanes] = 0
        self._observation = self._observation.copy()
        self._observation[lanes] = self.simulation.observe()[lanes]
