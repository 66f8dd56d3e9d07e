"""The stable-baselines3 environment: many Jitterbugs, observed in full or through an encoder."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from jbrep.encoders import Encoder
from jbrep.envs.episodes import Episodes, LaneState
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import EPISODE_STEPS, Array

Float32 = NDArray[np.float32]


class LatentEncoder(Protocol):
    """What the environment requires of an encoder."""

    @property
    def latent_size(self) -> int:
        """l, the number of latent features."""

    def __call__(self, observation: Float32, /) -> Float32:
        """Encode observations (n, d) in physical units as latents (n, l)."""


class JitterbugVecEnv(VecEnv):
    """Many Jitterbugs for stable-baselines3, stepped together as one MuJoCo batch.

    Observations are float32, scaled by the nominal ranges. With an encoder the agent sees latents
    instead, terminal ones too; the encoder gets observations in physical units. Lane i is seeded
    with `seed + i`.

    Args:
        task: a key of `jbrep.jitterbug.tasks.TASKS`.
        num_envs: the number of robots.
        seed: the seed of the first lane.
        encoder: a `jbrep.encoders.Encoder`, or any function of float32 observations in physical
            units with a `latent_size`; None gives the full observation.
        num_threads: threads to step them on; None takes one for each core.
        max_episode_steps: the time limit [control steps].

    Attributes:
        task: the task.
        episodes: the episodes under way in the lanes.

    When an episode ends, `infos[i]` holds `terminal_observation`, `TimeLimit.truncated` (always
    true: no state ends a task) and `non_finite` (whether the physics diverged).

    Raises:
        InputError: unknown task, a number below 1, an encoder made for other features or whose
            output doesn't have its `latent_size`; actions of another shape than (num_envs, 1).
        NonFiniteActionError: actions that are not finite.
    """

    render_mode = None

    def __init__(
        self,
        task: str,
        num_envs: int,
        seed: int = 0,
        encoder: LatentEncoder | None = None,
        num_threads: int | None = None,
        max_episode_steps: int = EPISODE_STEPS,
    ):
        self.episodes = Episodes(task, num_envs, num_threads, max_episode_steps)
        self.task = self.episodes.task
        self._encoder = encoder
        self._size = encoder.latent_size if encoder else self.task.size
        self._actions: NDArray[np.floating[Any]] = np.zeros((num_envs, 1))
        if isinstance(encoder, Encoder):
            encoder.check_task(self.task)
        self._represent(np.zeros((num_envs, self.task.size)))  # the encoder may refuse it
        super().__init__(
            num_envs,
            spaces.Box(-np.inf, np.inf, (self._size,), np.float32),
            spaces.Box(-1, 1, (1,), np.float32),
        )
        self.seed(seed)

    def reset(self) -> Float32:
        """Start an episode in every lane, from the seeds if they were set since the last reset."""
        observation = self.episodes.reset(self._seeds)
        self._reset_seeds()
        self._reset_options()
        return self._represent(observation)

    def step_async(self, actions: NDArray[np.floating]) -> None:
        """Keep the actions, (num_envs, 1), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Take one control step in every lane."""
        outcome = self.episodes.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if lanes := outcome.ended:
            finals = self._represent(outcome.final_observation[lanes])
            for lane, final in zip(lanes, finals, strict=True):
                infos[lane] = {
                    "terminal_observation": final,
                    "TimeLimit.truncated": True,
                    "non_finite": bool(outcome.diverged[lane]),
                }
        reward = outcome.reward.astype(np.float32)
        return self._represent(outcome.observation), reward, outcome.done, infos

    @property
    def state(self) -> LaneState:
        """A copy of what `restore` takes: everything that decides how the lanes continue."""
        return self.episodes.state

    def restore(self, state: LaneState) -> None:
        """Continue from where the state was taken, to the same bits."""
        self.episodes.restore(state)

    def _represent(self, observation: Array) -> Float32:
        if self._encoder is None:
            return self.task.scale(observation).astype(np.float32)
        latent = np.asarray(self._encoder(observation.astype(np.float32)), dtype=np.float32)
        if latent.shape != (len(observation), self._size):
            raise InputError(
                f"the encoder returned shape {latent.shape} for {len(observation)} observations of "
                f"{self.task.name}: its latent_size asks for ({len(observation)}, {self._size})"
            )
        return latent

    def close(self) -> None:
        """Do nothing: no resource is held."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Get an attribute of this environment, which the lanes share."""
        return self._for_lanes(indices, lambda: getattr(self, attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this environment, for all lanes."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of this environment once; the result is repeated for every lane."""
        result = getattr(self, method_name)(*args, **kwargs)
        return self._for_lanes(indices, lambda: result)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """False: no lane is an environment of its own."""
        return self._for_lanes(indices, lambda: False)

    def _for_lanes(self, indices: VecEnvIndices, value: Callable[[], Any]) -> list[Any]:
        lanes: Sequence[int] = range(self.num_envs)
        if isinstance(indices, int):
            lanes = [indices]
        elif indices is not None:
            lanes = list(indices)
        return [value() for _ in lanes]
