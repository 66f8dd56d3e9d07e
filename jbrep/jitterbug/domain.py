"""The Jitterbug as a dm_control domain."""

import sys
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from jbrep.envs.task import Array
from jbrep.errors import InputError
from jbrep.jitterbug import tasks
from jbrep.jitterbug.bodies import read_xml
from jbrep.jitterbug.tasks import Readings
from jbrep.opengl import prepare_opengl

prepare_opengl()  # dm_control chooses its platform, and opens EGL, when it is imported

try:
    from dm_control import mujoco, suite
    from dm_control.rl import control
    from dm_control.suite import base
    from dm_control.utils import containers
except ModuleNotFoundError as error:
    raise InputError(
        f"a dm_control environment needs {error.name}: pip install 'jbrep[dm-control]', with "
        "Python 3.11 or 3.12; the Jitterbug's Gymnasium and vector environments don't need it"
    ) from error

DOMAIN = "jitterbug"
SUITE = containers.TaggedTasks()
_TIME_LIMIT = tasks.EPISODE_STEPS * tasks.CONTROL_TIMESTEP  # [s]


class Physics(mujoco.Physics):
    """The robot and its target."""

    def readings(self) -> Readings:
        """What the tasks read, as a batch of one; the arrays are views."""
        data, named = self.data, self.named.data
        return Readings(
            data.qpos[None],
            data.qvel[None],
            named.xmat["jitterbug"][None],
            data.sensordata[None],
            data.mocap_pos,
            tasks.yaw_direction(data.mocap_quat),
        )


class Jitterbug(base.Task):
    """One of the five tasks.

    Args:
        task: its name, a key of `tasks.TASKS`.
        random: a `RandomState`, a seed, or None. A seed gives the same episodes as in the
            Gymnasium environment.
    """

    def __init__(self, task: str, random: np.random.RandomState | int | None = None):
        self._task = tasks.get_task(task)
        if not isinstance(random, np.random.RandomState):
            random = np.random.RandomState(np.random.PCG64(random))
        super().__init__(random=random)

    def initialize_episode(self, physics: Physics) -> None:
        """Draw the robot's orientation and the target from the task's generator."""
        start = self._task.start(self.random)
        physics.data.qpos[tasks.QUATERNION] = start.quaternion
        physics.data.mocap_pos[0] = start.target_position
        physics.data.mocap_quat[0] = start.target_quaternion
        physics.forward()
        super().initialize_episode(physics)

    def get_observation(self, physics: Physics) -> OrderedDict[str, Array]:
        """The observables by name, in the order of the flat observation."""
        observation = self._task.observe(physics.readings())[0]
        parts = self._task.plain.split(observation)
        return OrderedDict((name, part.copy()) for name, part in parts.items())

    def get_reward(self, physics: Physics) -> float:
        """The reward, in [0, 1]."""
        return float(self._task.reward(physics.readings())[0])


def _factory(name: str) -> Callable[..., control.Environment]:
    def make(
        time_limit: float = _TIME_LIMIT,
        random: np.random.RandomState | int | None = None,
        environment_kwargs: dict[str, Any] | None = None,
    ) -> control.Environment:
        return control.Environment(
            Physics.from_xml_string(read_xml()),
            Jitterbug(name, random=random),
            time_limit=time_limit,
            control_timestep=tasks.CONTROL_TIMESTEP,
            **(environment_kwargs or {}),
        )

    make.__name__ = name
    make.__doc__ = f"Returns the {name} task."
    return make


for _task in tasks.TASKS.values():
    SUITE.add("benchmarking", _task.level)(_factory(_task.name))


def load(
    task: str,
    seed: int | None = None,
    time_limit: float = _TIME_LIMIT,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
) -> control.Environment:
    """Make a dm_control environment of a task.

    Args:
        task: a key of `tasks.TASKS`.
        seed: of all draws; None draws one.
        time_limit: of an episode [s].
        environment_kwargs: for `dm_control.rl.control.Environment`.
        visualize_reward: colour the robot by its reward.
    """
    name = tasks.get_task(task).name
    environment = SUITE[name](time_limit, seed, environment_kwargs)
    environment.task.visualize_reward = visualize_reward
    return environment


def register_with_suite() -> None:
    """Add the tasks to `suite.load` and to all task lists of dm_control's suite."""
    suite._DOMAINS[DOMAIN] = sys.modules[__name__]
    suite.ALL_TASKS = suite._get_tasks(tag=None)
    suite.BENCHMARKING = suite._get_tasks("benchmarking")
    suite.EASY = suite._get_tasks("easy")
    suite.HARD = suite._get_tasks("hard")
    suite.EXTRA = tuple(sorted(set(suite.ALL_TASKS) - set(suite.BENCHMARKING)))
    suite.NO_REWARD_VIZ = suite._get_tasks("no_reward_visualization")
    suite.REWARD_VIZ = tuple(sorted(set(suite.ALL_TASKS) - set(suite.NO_REWARD_VIZ)))
    suite.TASKS_BY_DOMAIN = suite._get_tasks_by_domain(suite.ALL_TASKS)
