"""Gymnasium environments: one robot, and many stepped together."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from jbrep.envs.episodes import Episodes
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation, check_actions
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, EPISODE_STEPS, Array, Task, get_task
from jbrep.opengl import has_display, no_opengl, prepare_opengl

Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]

_FORMS = ("flat", "dict")
_ACTIONS = spaces.Box(-1, 1, (1,), np.float32)


@dataclass(frozen=True)
class _View:
    """How observations are handed out: in which units and which form."""

    task: Task
    scaled: bool
    form: str

    def __post_init__(self) -> None:
        if self.form not in _FORMS:
            raise InputError(f"unknown form {self.form!r}: choose one of {', '.join(_FORMS)}")

    @property
    def space(self) -> spaces.Space[Any]:
        if self.form == "flat":
            return _box(self.task.size)
        return spaces.Dict([(o.name, _box(len(o.features))) for o in self.task.observables])

    def __call__(self, observation: Array) -> Observation:
        """Observations in physical units, (..., d), as the space has them."""
        if self.scaled:
            observation = self.task.scale(observation)
        single = observation.astype(np.float32)
        return single if self.form == "flat" else self.task.split(single)


def _render_modes() -> list[str]:
    """Those that this machine allows: without a display GLFW's window aborts the process."""
    modes = JitterbugEnv.metadata["render_modes"]
    return [mode for mode in modes if mode != "human" or has_display()]


def _box(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


class JitterbugEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One Jitterbug; `gymnasium.make` adds the time limit.

    Args:
        task: a key of `jbrep.jitterbug.tasks.TASKS`.
        scaled: features divided by their nominal ranges, about [-1, 1], not in physical units.
        form: "flat" for one array (d,), "dict" for a dictionary of observables.
        render_mode: "rgb_array", "depth_array", "human" or None.
        camera: "overhead", "tracking" or "egocentric".
        width, height: of a frame [pixels].

    When the physics diverges, the episode is truncated with the last finite observation, reward
    0 and `info["non_finite"]` true.

    Raises:
        InputError: unknown task, form or render mode, or "human" without a display; an action of
            another shape than (1,), or not finite.
    """

    metadata = {  # noqa: RUF012 (Gymnasium's own convention)
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": round(1 / CONTROL_TIMESTEP),
    }

    def __init__(
        self,
        task: str,
        scaled: bool = False,
        form: str = "flat",
        render_mode: str | None = None,
        camera: str = "tracking",
        width: int = 640,
        height: int = 480,
    ):
        self.task = get_task(task)
        self._view = _View(self.task, scaled, form)
        self.metadata = {**self.metadata, "render_modes": _render_modes()}
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(
                f"render_mode {render_mode!r} can't be had here: choose one of "
                f"{', '.join(self.metadata['render_modes'])}; human takes a display"
            )
        self._simulation = Simulation(self.task, 1, 1)
        self.model = self._simulation.model
        self.observation_space = self._view.space
        self.action_space = _ACTIONS
        self.render_mode = render_mode
        self._frame: dict[str, Any] = {"camera_name": camera, "width": width, "height": height}
        self._renderer: Any = None
        self._data: Any = None

    @property
    def data(self) -> Any:
        """The robot's state now, as a `mujoco.MjData`."""
        self._data = self._simulation.copy_data(0, self._data)
        return self._data

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; there are no options."""
        super().reset(seed=seed)
        self._simulation.reset([0], [self.np_random])
        self._observation = self._simulation.observe()[0]
        return self._view(self._observation), {}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold the drive, (1,), for one control step of 0.01 s."""
        diverged = bool(self._simulation.step(check_actions(np.asarray(action)[None], 1))[0])
        if diverged:
            reward = 0.0
        else:
            reward = float(self._simulation.reward()[0])
            self._observation = self._simulation.observe()[0]
        return self._view(self._observation), reward, False, diverged, {"non_finite": diverged}

    def render(self) -> Any:
        """A frame, as Gymnasium's own MuJoCo environments give it.

        Raises:
            InputError: no OpenGL to render with, or a package that rendering takes is missing.
        """
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
                f"rendering takes {error.name}: pip install 'jbrep[render]'"
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

    Lane i of an environment that is reset with seed s has the episodes of a single environment
    reset with seed s + i. An episode that ends starts anew in the same step.

    Args:
        task, scaled, form: as of `JitterbugEnv`.
        num_envs: how many robots.
        max_episode_steps: the time limit, in control steps.
        num_threads: threads to step them on; None takes one for each core.

    Raises:
        InputError: unknown task or form, a number below 1; actions of another shape than
            (num_envs, 1), or not finite.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        scaled: bool = False,
        form: str = "flat",
        max_episode_steps: int = EPISODE_STEPS,
        num_threads: int | None = None,
    ):
        self._episodes = Episodes(task, num_envs, num_threads, max_episode_steps)
        self._view = _View(self._episodes.task, scaled, form)
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
        """Start an episode in every lane; there are no options."""
        if seed is None or isinstance(seed, int):
            seed = [None if seed is None else seed + lane for lane in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise InputError(f"{len(seed)} seeds for {self.num_envs} lanes: one for each is needed")
        return self._view(self._episodes.reset(seed)), {}

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """One control step in every lane."""
        outcome = self._episodes.step(actions)
        info: dict[str, Any] = {}
        for lane in outcome.ended:
            final = {
                "final_obs": self._view(outcome.final_observation[lane]),
                "final_info": {"non_finite": bool(outcome.diverged[lane])},
            }
            info = self._add_info(info, final, lane)
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        return self._view(outcome.observation), outcome.reward, terminated, outcome.done, info
