"""Episodes in many lanes: seeds, time limit, and reset in the step that ends an episode."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation, check_actions
from jbrep.jitterbug.tasks import EPISODE_STEPS, Array, get_task


class Outcome(NamedTuple):
    """The result of one step in each of n lanes; treat the arrays as read-only."""

    observation: Array  # (n, d) the first of the next episode where one ended
    reward: Array  # (n,) 0 where the physics diverged
    done: NDArray[np.bool_]  # (n,)
    ended: list[int]  # the lanes where done
    diverged: NDArray[np.bool_]  # (n,)
    final_observation: Array  # (n, d) before any reset; the last finite one where it diverged


class LaneState(NamedTuple):
    """Everything that decides how n lanes continue."""

    arrays: dict[str, Array]  # (n, ...) each
    generators: list[Any]  # the state of each lane's random generator, as plain JSON


class Episodes:
    """Endless episodes of a task in n lanes, each lane with a random generator of its own.

    An episode ends at the time limit or when its physics diverges. Both truncate it; no state of
    the robot terminates an episode.

    Args:
        task: a key of `jbrep.jitterbug.tasks.TASKS`.
        num_lanes: n.
        num_threads: threads to step the lanes on; None takes one for each core.
        max_episode_steps: the time limit [control steps].

    Raises:
        InputError: unknown task, or a number below 1.
    """

    def __init__(
        self,
        task: str,
        num_lanes: int,
        num_threads: int | None = None,
        max_episode_steps: int = EPISODE_STEPS,
    ):
        if max_episode_steps < 1:
            raise InputError(
                f"the number of steps in an episode is {max_episode_steps}: it must be at least 1"
            )
        self.task = get_task(task)
        self.simulation = Simulation(self.task, num_lanes, num_threads)
        self._max_steps = max_episode_steps
        self._steps = np.zeros(num_lanes, dtype=np.int64)
        self._generators = [np.random.default_rng() for _ in range(num_lanes)]
        self._observation = np.zeros((num_lanes, self.task.size))

    def reset(self, seeds: Sequence[int | None]) -> Array:
        """Start an episode in every lane; a lane whose seed is None keeps its generator.

        Returns:
            The first observations in physical units, (n, d).
        """
        for lane, seed in enumerate(seeds):
            if seed is not None:
                self._generators[lane] = np.random.default_rng(seed)
        self._restart(range(self.simulation.num_lanes))
        return self._observation

    def step(self, actions: ArrayLike) -> Outcome:
        """Take one control step in every lane.

        Raises:
            InputError: actions of another shape than (n, 1).
            NonFiniteActionError: actions that are not finite.
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
    def state(self) -> LaneState:
        """A copy of what `restore` takes."""
        arrays = {**self.simulation.state, "observation": self._observation.copy()}
        arrays["steps"] = self._steps.astype(np.float64)
        return LaneState(arrays, [each.bit_generator.state for each in self._generators])

    def restore(self, state: LaneState) -> None:
        """Continue from where the state was taken, to the same bits."""
        physics = dict(state.arrays)
        self._steps[:] = physics.pop("steps")
        self._observation = physics.pop("observation").copy()
        for generator, words in zip(self._generators, state.generators, strict=True):
            generator.bit_generator.state = words
        self.simulation.restore(**physics)

    def _restart(self, lanes: Sequence[int]) -> None:
        self.simulation.reset(lanes, [self._generators[lane] for lane in lanes])
        self._steps[lanes] = 0
        self._observation = self._observation.copy()
        self._observation[lanes] = self.simulation.observe()[lanes]
