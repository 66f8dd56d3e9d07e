"""Many Jitterbugs, stepped together on a pool of threads."""

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.checks import check_counts
from jbrep.jitterbug import model
from jbrep.jitterbug.tasks import QUATERNION, Array, JitterbugTask, Readings, yaw_direction

_UP_TO_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)
# on a position, velocity or acceleration that isn't finite, MuJoCo warns and resets the lane
_NOT_FINITE = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1
)


class Simulation:
    """n Jitterbugs in n lanes; what a lane does depends on its own start and actions alone.

    Neither the number of lanes nor that of threads changes a bit of any trajectory.

    Args:
        task: what is observed and rewarded.
        num_lanes: n, the number of robots.
        num_threads: threads to step them on; None takes one for each core.

    Attributes:
        readings: what the tasks read of the current states; a new object after each step.
        model: the compiled MuJoCo model.
        target_quaternion: of the lanes' targets, (n, 4).

    Raises:
        InputError: a number below 1.
    """

    def __init__(self, task: JitterbugTask, num_lanes: int, num_threads: int | None = None):
        check_counts(num_lanes, num_threads)
        model.stop_profiling()
        self.task = task
        self.num_lanes = num_lanes
        self.model = model.fast_model()
        # persistent: a step reuses what has already been computed for the readings
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

    def __repr__(self) -> str:
        return f"Simulation({self.task.name}, {self.num_lanes:,} lanes)"

    def reset(self, lanes: Sequence[int], randoms: Iterable[np.random.Generator]) -> None:
        """Start an episode in each of the lanes, drawn from its own generator."""
        self._batch.reset(lanes, stage=mujoco.mjtStage.mjSTAGE_NONE)
        for lane, random in zip(lanes, randoms, strict=True):
            start = self.task.start(random)
            self.readings.qpos[lane, QUATERNION] = start.quaternion
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
        """Put all lanes in stored states: (n, 16), (n, 15), (n, 3) and (n, 4).

        The same actions then lead through the same states, bit for bit. After an episode's first
        state this also takes the warm start (n, 15) of MuJoCo's solver.
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
            Whether each lane's physics has diverged since its reset, (n,). Such a lane and its
            target were put in their default states, and its episode has ended.
        """
        self._control[:] = action
        self._batch.step(nstep=model.PHYSICS_STEPS, stage=_UP_TO_VELOCITIES)
        self.readings = Readings(*self._views)
        return self._warnings.any(axis=1)

    def observe(self) -> Array:
        """The observations in physical units, (n, d)."""
        return self.task.observe(self.readings)

    def reward(self) -> Array:
        """The rewards of the current states, (n,)."""
        return self.task.reward(self.readings)

    def copy_data(self, lane: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """A lane as a MuJoCo data object with positions up to date, to render or inspect."""
        data = self._batch.get_data(lane, data)
        mujoco.mj_fwdPosition(self.model, data)
        return data
