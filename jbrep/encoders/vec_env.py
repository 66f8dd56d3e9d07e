"""The environments of stable-baselines3, observed in full or by an encoder."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from jbrep.encoders.base import BaseEncoder, Float32
from jbrep.encoders.shipped import find
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.description import describe
from jbrep.envs.environments import State, check_actions
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError


def agent_spaces(
    task: Task, encoder: BaseEncoder | None, chunk: int = 1
) -> tuple[spaces.Box, spaces.Box]:
    """The spaces of what an agent observes and of the actions that it chooses at once.

    Actions are scaled to [-1, 1].
    """
    size = encoder.latent_size if encoder else task.size
    acts = spaces.Box(-1, 1, (chunk * task.action_size,))
    return spaces.Box(-np.inf, np.inf, (size,), np.float32), acts


class JitterbugVecEnv(VecEnv):
    """Many environments of a task for stable-baselines3, stepped together where that is possible.

    Observations are float32, scaled by the task's usual ranges, or else the latents of an encoder,
    which gets them in physical units. Actions are scaled to [-1, 1] from their bounds.

    The first episode of environment i has the seed `seed + i`, as Gymnasium has it; episode k
    from 1 on has a number below 2^31 drawn from (seed + i, k), so that each episode can be played
    again by itself.

    Args:
        task: a task, or the name or id of one.
        num_envs: the number of environments.
        seed: of the first environment.
        encoder: a `jbrep.encoders.Encoder`, or a user's own (see `jbrep.encoders.base.OwnEncoder`);
            None gives the full observation.
        num_threads: threads to step the environments on; None takes one for each core.
        max_episode_steps: the time limit of a task given by its name [steps].
        action_repeat: control steps for which each action is held, fewer where an episode ends
            before; a step of the environment, whose reward is their sum.
        retries: how often in a row an environment that fails is made anew; its episode ends
            truncated, before the step that failed.

    Attributes:
        task: the task.
        envs: the episodes under way.

    When an episode ends, `infos[i]` holds `terminal_observation` and `TimeLimit.truncated`, whether
    it ended without a terminal state, and `control_steps`, its length; the Jitterbug's also
    `non_finite`, whether its physics diverged.

    Raises:
        NonFiniteActionError: actions that are not finite.
        EnvironmentFailedError: the environment fails in the middle of an episode.
    """

    render_mode = None
    scales = True  # observations and actions: a network without it acts otherwise

    def __init__(
        self,
        task: Task | str,
        num_envs: int,
        seed: int = 0,
        encoder: Any = None,
        num_threads: int | None = None,
        max_episode_steps: int | None = None,
        action_repeat: int = 1,
        retries: int = 0,
    ):
        if isinstance(task, str):
            task = describe(task, episode_steps=max_episode_steps)
        elif max_episode_steps not in (None, task.max_episode_steps):
            raise InputError(f"{task.name} is described with its time limit: describe it anew")
        self.task = task
        self._encoder = None if encoder is None else find(encoder, task)
        self._robots = AutoresetEnvironments(task, num_envs, num_threads, action_repeat, retries)
        self.envs = self._robots.envs
        observation_space, action_space = agent_spaces(task, self._encoder)
        self._actions = np.zeros((num_envs, task.action_size))
        super().__init__(num_envs, observation_space, action_space)
        if seed < 0:
            raise InputError(f"seed is {seed}: it must be at least 0")
        self.seed(seed)

    def reset(self) -> Float32:
        """Start an episode in each: the first one if seeds were set since, else the next."""
        observation = self._robots.reset(self._seeds)
        self._reset_seeds()
        self._reset_options()
        return self._represent(observation)

    def restart(self) -> Float32:
        """Start the episodes of now once more, as after others were played instead."""
        return self._represent(self._robots.restart())

    def step_async(self, actions: NDArray[np.floating]) -> None:
        checked = check_actions(actions, self.num_envs, self.task.action_size)
        self._actions = self.task.unscale_action(checked)

    def step_wait(self) -> VecEnvStepReturn:
        moved = self._robots.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if moved.ended.any():
            ended = np.flatnonzero(moved.ended).tolist()
            finals = self._represent(moved.final[ended])
            for index, final in zip(ended, finals, strict=True):
                infos[index] = {
                    "terminal_observation": final,
                    "TimeLimit.truncated": not moved.terminated[index],
                    **moved.end_info(index),
                }
        reward = moved.reward.astype(np.float32)
        return self._represent(moved.observation), reward, moved.ended, infos

    @property
    def state(self) -> State:
        """A copy of what `restore` takes: everything that decides how the environments continue."""
        return self._robots.state

    def restore(self, state: State) -> None:
        """Continue from where the state was taken, to the same bits."""
        self._robots.restore(state)

    def _represent(self, observation: Array) -> Float32:
        if self._encoder is None:
            return self.task.scale(observation).astype(np.float32)
        return self._encoder.encode(observation.astype(np.float32))

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        result = getattr(self, method_name)(*args, **kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]
