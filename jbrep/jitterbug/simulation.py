"""Many Jitterbugs, stepped together on a pool of threads."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike, NDArray

from jbrep.errors import InputError
from jbrep.jitterbug import model
from jbrep.jitterbug.tasks import Array, Readings, Task, yaw_direction

_UP_TO_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)
# on a position, velocity or acceleration that is not finite, MuJoCo warns and resets the lane
_NOT_FINITE = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1
)


class NonFiniteActionError(InputError):
    """An action is NaN or infinite."""


class Simulation:
    """n Jitterbugs in n lanes; what a lane does depends on its own start and actions alone.

    Neither the number of lanes nor that of threads changes a bit of any trajectory.

    Args:
        task: what is observed and rewarded.
        num_lanes: n, how many robots.
        num_threads: threads to step them on; None takes one for each core.

    Attributes:
        readings: what the tasks read of the lanes now; new after each step.
        model: the compiled MuJoCo model.
        target_quaternion: of the lanes' targets, (n, 4).

    Raises:
        InputError: a number below 1.
    """

    def __init__(self, task: Task, num_lanes: int, num_threads: int | None = None):
        check_counts(num_lanes, num_threads)
        model.stop_profiling()
        self.task = task
        self.num_lanes = num_lanes
        self.model = model.fast_model()
        # persistent: a lane's next step goes on from what reading it has computed already
        self._batch = Batch(self.model, num_lanes, num_threads or 0, persistent=True)
        self._control = self._batch.bind("ctrl")
        body = self.model.body("jitterbug").id
        self._warnings = self._batch.warning[:, _NOT_FINITE, 1]
        self._views = (
            self._batch.bind("qpos"),
            self._batch.bind("qvel"),
            self._batch.bind("xmat")[:, body],
            self._batch.bind("sensordata"),
            self._batch.bind("mocap_pos")[:, 0],
            np.zeros((num_lanes, 2)),
        )
        self.target_quaternion = self._batch.bind("mocap_quat")[:, 0]
        self._warmstart = self._batch.bind("qacc_warmstart")
        self.readings = Readings(*self._views)

    def reset(self, lanes: Sequence[int], randoms: Iterable[np.random.Generator]) -> None:
        """Start an episode in each of the lanes, drawn from the generator that goes with it."""
        self._batch.reset(lanes, stage=mujoco.mjtStage.mjSTAGE_NONE)
        for lane, random in zip(lanes, randoms, strict=True):
            start = self.task.start(random)
            self.readings.qpos[lane, 3:7] = start.quaternion
            self.readings.target_position[lane] = start.target_position
            self.target_quaternion[lane] = start.target_quaternion
        self._forward(lanes)

    @property
    def state(self) -> dict[str, Array]:
        """A copy of what `restore` takes."""
        now = self.readings
        return {
            "qpos": now.qpos.copy(),
            "qvel": now.qvel.copy(),
            "target_position": now.target_position.copy(),
            "target_quaternion": self.target_quaternion.copy(),
            "warmstart": self._warmstart.copy(),
        }

    def restore(
        self,
        qpos: Array,
        qvel: Array,
        target_position: Array,
        target_quaternion: Array,
        warmstart: ArrayLike = 0.0,
    ) -> None:
        """Put the lanes in stored states: (n, 16), (n, 15), (n, 3) and (n, 4).

        The same actions lead from there through the same states, bit for bit. Past an episode's
        first state that needs the warm start, (n, 15), where MuJoCo's solver starts its search.
        """
        lanes = range(self.num_lanes)
        self._batch.reset(lanes, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.readings.qpos[:] = qpos
        self.readings.qvel[:] = qvel
        self.readings.target_position[:] = target_position
        self.target_quaternion[:] = target_quaternion
        self._warmstart[:] = warmstart
        self._forward(lanes)

    def _forward(self, lanes: Sequence[int]) -> None:
        self.readings.target_axis[:] = yaw_direction(self.target_quaternion)
        self._batch.forward(lanes, stage=_UP_TO_VELOCITIES)
        self.readings = Readings(*self._views)

    def step(self, action: Array) -> NDArray[np.bool_]:
        """Hold the actions (n, 1) for one control step.

        Returns:
            (n,) whether the lane's physics diverged: it and its target stand in their default
            states then, and its episode is over.
        """
        self._control[:] = action
        self._batch.step(nstep=model.PHYSICS_STEPS, stage=_UP_TO_VELOCITIES)
        self.readings = Readings(*self._views)
        return self._warnings.any(axis=1)

    def observe(self) -> Array:
        """The observations in physical units, (n, d)."""
        return self.task.observe(self.readings)

    def reward(self) -> Array:
        """The rewards of the states that the lanes are in, (n,)."""
        return self.task.reward(self.readings)

    def copy_data(self, lane: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """A lane as a MuJoCo data object with its positions current, to render or inspect."""
        data = self._batch.get_data(lane, data)
        mujoco.mj_fwdPosition(self.model, data)
        return data


def check_counts(num_lanes: int, num_threads: int | None) -> None:
    """Make sure that there is something to simulate, and to simulate it on.

    Raises:
        InputError: a number below 1.
    """
    for count, what in ((num_lanes, "robots"), (num_threads, "threads")):
        if count is not None and count < 1:
            raise InputError(f"the number of {what} is {count}: it must be at least 1")


def check_actions(actions: ArrayLike, num_lanes: int) -> Array:
    """The actions as (num_lanes, 1) float64.

    Raises:
        InputError: another shape.
        NonFiniteActionError: a value that is not finite.
    """
    checked: Array = np.asarray(actions, dtype=np.float64)
    if checked.shape != (num_lanes, 1):
        raise InputError(
            f"actions have shape {checked.shape}: ({num_lanes}, 1) is needed, one motor drive "
            "in [-1, 1] for each robot"
        )
    if not np.isfinite(checked).all():
        raise NonFiniteActionError(
            f"actions are not finite: {checked.ravel()}; they must be in [-1, 1]"
        )
    return checked
