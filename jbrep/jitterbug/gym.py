"""Gymnasium environments: one robot, or many stepped together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from jbrep.envs.environments import check_actions
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, choose
from jbrep.jitterbug.bodies import check_body
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, EPISODE_STEPS, JitterbugTask, get_task
from jbrep.opengl import has_display, no_opengl, prepare_opengl

Observation = NDArray[Any]

_TYPES = {name: np.dtype(name) for name in ("float32", "float64")}
_BODY_ARGUMENTS = {"body", "materials"}
_ACTIONS = spaces.Box(-1, 1, (1,), np.float32)


@dataclass(frozen=True)
class _View:
    task: JitterbugTask
    scaled: bool
    dtype: str = "float32"

    def __post_init__(self) -> None:
        choose(self.dtype, _TYPES, "dtype")

    @property
    def space(self) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (self.task.plain.size,), _TYPES[self.dtype].type)

    def __call__(self, observation: Array) -> Observation:
        """Convert observations in physical units, (..., d), to those of the space."""
        given = self.task.plain.scale(observation) if self.scaled else observation
        return given.astype(_TYPES[self.dtype])


def describe(arguments: Mapping[str, Any], max_episode_steps: int | None) -> Task:
    """A task as plain data, see `jbrep.envs.description`."""
    given = {name: value for name, value in arguments.items() if name != "task"}
    if unknown := set(given) - _BODY_ARGUMENTS:
        raise InputError(
            f"the Jitterbug has no argument {min(unknown)} that changes the robot: choose from "
            f"{', '.join(sorted(_BODY_ARGUMENTS))}"
        )
    check_body(given.get("body"), given.get("materials", False))
    return get_task(arguments["task"]).describe(given, max_episode_steps)


class JitterbugEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One Jitterbug; `gymnasium.make` adds the time limit.

    Args:
        task: a key of `jbrep.jitterbug.tasks.TASKS`.
        scaled: scale features by their usual ranges to about [-1, 1] instead of giving physical
            units.
        render_mode: "rgb_array", "depth_array", "human" or None.
        camera: "overhead", "tracking" or "egocentric".
        width, height: of a frame [pixels].
        body, materials: as for `jbrep.jitterbug.simulation.Simulation`.

    When the physics diverges, the episode is truncated with the last finite observation, reward
    0 and `info["non_finite"]` true.
    """

    describe = staticmethod(describe)
    metadata = {
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": round(1 / CONTROL_TIMESTEP),
    }

    def __init__(
        self,
        task: str,
        scaled: bool = False,
        render_mode: str | None = None,
        camera: str = "tracking",
        width: int = 640,
        height: int = 480,
        body: int | str | None = None,
        materials: bool = False,
    ):
        self.task = get_task(task)
        self.scaled, self._view = scaled, _View(self.task, scaled)
        modes = self.metadata["render_modes"]
        if not has_display():  # opening a window would abort the process
            modes = [mode for mode in modes if mode != "human"]
        self.metadata = {**self.metadata, "render_modes": modes}
        if render_mode not in (None, *modes):
            raise InputError(
                f"render_mode {render_mode!r} is not possible here: choose one of "
                f"{', '.join(modes)}; human needs a display"
            )
        self._simulation = Simulation(self.task, 1, 1, body, materials)
        choose(camera, {self.model.camera(i).name: i for i in range(self.model.ncam)}, "camera")
        self.observation_space = self._view.space
        self.action_space = _ACTIONS
        self.render_mode = render_mode
        self._frame: dict[str, Any] = {"camera_name": camera, "width": width, "height": height}
        self._renderer: Any = None
        self._data: Any = None

    @property
    def model(self) -> mujoco.MjModel:
        """The robot's model; a new one once it has another body."""
        return self._simulation.model_of(0)

    @property
    def data(self) -> Any:
        """The robot's state now, as a `mujoco.MjData`."""
        self._data = self._simulation.copy_data(0, self._data)
        return self._data

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; `options` are ignored."""
        super().reset(seed=seed)
        before = self._simulation.body_numbers[0]
        self._simulation.reset([0], [self.np_random])
        if self._simulation.body_numbers[0] != before:
            self.close()  # the renderer shows the other body
            self._data = None
        self._observation = self._simulation.observe()[0]
        return self._view(self._observation), {}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold the drive, (1,), for one control step of 0.01 s."""
        diverged = bool(self._simulation.step(check_actions(np.asarray(action)[None], 1, 1))[0])
        if diverged:
            reward = 0.0
        else:
            reward = float(self._simulation.reward()[0])
            self._observation = self._simulation.observe()[0]
        return self._view(self._observation), reward, False, diverged, {"non_finite": diverged}

    def quarter_turn(self, shift: tuple[float, float]) -> None:
        """Turn robot and target by a quarter about the vertical axis, then shift both [m]."""
        self._simulation.quarter_turn(shift)

    def render(self) -> Any:
        """A frame, as Gymnasium's own MuJoCo environments give it."""
        if self.render_mode is None:
            return None
        data = self.data
        prepare_opengl()
        try:
            if self._renderer is None:
                from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

                self._renderer = MujocoRenderer(self.model, data, **self._frame)
            return self._renderer.render(self.render_mode)
        except ModuleNotFoundError as error:
            raise InputError(
                f"rendering needs {error.name}: pip install 'jbrep[render]'"
            ) from error
        except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
            raise no_opengl(error) from error

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class JitterbugVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Many Jitterbugs stepped together; what `gymnasium.make_vec` gives.

    Reset with seed s, robot i has the episodes of a single environment reset with seed s + i. Infos
    hold `qpos`, `qvel`, `target_position` and `target_quaternion` of each robot's state, and the
    number of its `body`, -1 for the published one.

    Options of `reset` may have the `body`, `friction` and `mass` of each robot that it starts, (n,)
    each: a number, and factors of what the model has.

    Args:
        task, scaled, body, materials: as for `JitterbugEnv`.
        num_envs: how many robots.
        max_episode_steps: the time limit, in control steps.
        num_threads: threads to step them on; None takes one for each core.
        autoreset_mode: SAME_STEP, which resets an environment in the step that ends its episode, or
            DISABLED, which leaves it to `reset` with `options={"reset_mask": ...}`.
        dtype: of observations, float32 or float64.
    """

    changeable = ("friction", "mass", "push", "body")  # by a domain, see `jbrep.envs.domain`

    resets_envs = True  # as `jbrep.envs.make.is_batched` asks

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        scaled: bool = False,
        max_episode_steps: int = EPISODE_STEPS,
        num_threads: int | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
        dtype: str = "float32",
        body: int | str | None = None,
        materials: bool = False,
    ):
        if max_episode_steps < 1:
            raise InputError(
                f"the number of steps in an episode is {max_episode_steps}: it must be at least 1"
            )
        if autoreset_mode not in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED):
            raise InputError(f"{autoreset_mode} is not possible: choose SAME_STEP or DISABLED")
        self.task = get_task(task)
        self.simulation = Simulation(self.task, num_envs, num_threads, body, materials)
        self.metadata = {"autoreset_mode": autoreset_mode}
        self._resets = autoreset_mode == AutoresetMode.SAME_STEP
        self.scaled, self._view = scaled, _View(self.task, scaled, dtype)
        self._max_steps = max_episode_steps
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._observation = np.zeros((num_envs, self.task.plain.size))  # the last finite ones
        self.num_envs = num_envs
        self.single_observation_space = self._view.space
        self.single_action_space = _ACTIONS
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(_ACTIONS, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in every environment, or where the option `reset_mask`, (n,), is true.

        An environment without a seed draws from its generator as it is.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else seed + index for index in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(
                f"{len(seed)} seeds for {self.num_envs} environments: give one for each environment"
            )
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_))
        indices = np.flatnonzero(mask).tolist()
        for index in indices:
            if (number := seed[index]) is not None:
                self._generators[index] = np.random.default_rng(number)
        self._restart(indices, options or {})
        return self._view(self._observation), self._info()

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One control step in every environment.

        A robot whose physics diverges is truncated with its last finite observation, reward 0 and
        `non_finite` true in its info.
        """
        diverged = self.simulation.step(check_actions(actions, self.num_envs, 1))
        reward, observation = self.simulation.reward(), self.simulation.observe()
        self._steps += 1
        truncated = diverged | (self._steps >= self._max_steps)
        if diverged.any():
            reward[diverged] = 0
            observation[diverged] = self._observation[diverged]
        self._observation = observation
        info: dict[str, Any] = {}
        if self._resets and truncated.any():
            for index in np.flatnonzero(truncated).tolist():
                final = {
                    "final_obs": self._view(observation[index]),
                    "final_info": {"non_finite": bool(diverged[index])},
                }
                info = self._add_info(info, final, index)
            self._restart(np.flatnonzero(truncated).tolist())
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        info |= self._info(non_finite=diverged)
        return self._view(self._observation), reward, terminated, truncated, info

    @property
    def models(self) -> list[mujoco.MjModel]:
        """The model of each environment's robot, as described."""
        return [self.simulation.model_of(index) for index in range(self.num_envs)]

    @property
    def mujoco_state(self) -> dict[str, Array]:
        """What pictures follow from: arrays of `mujoco.MjData`, (n, ...) each."""
        return self.simulation.mujoco_state

    def push(self, velocity: Array) -> None:
        self.simulation.push(velocity)

    def _restart(self, indices: Sequence[int], options: Mapping[str, Any] = {}) -> None:
        usual = np.ones(self.num_envs)
        factors = [options.get(name, usual) for name in ("friction", "mass")]
        self.simulation.reset(
            indices,
            [self._generators[index] for index in indices],
            options["body"][indices] if "body" in options else None,
            np.stack(factors, axis=1)[indices],
        )
        self._steps[indices] = 0
        self._observation = self._observation.copy()
        self._observation[indices] = self.simulation.observe()[indices]

    def _info(self, **others: NDArray[Any]) -> dict[str, Any]:
        """The state of each environment and more, as Gymnasium's vector environments give infos."""
        now = self.simulation.readings
        arrays = {
            "qpos": now.qpos.copy(),
            "qvel": now.qvel.copy(),
            "target_position": now.target_position.copy(),
            "target_quaternion": self.simulation.target_quaternion.copy(),
            "body": self.simulation.body_numbers[:, None],
            **others,
        }
        every_env = np.ones(self.num_envs, np.bool_)
        return arrays | dict.fromkeys((f"_{name}" for name in arrays), every_env)
