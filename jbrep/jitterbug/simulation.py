"""Many Jitterbugs, stepped together on a pool of threads, and the models that they have."""

import copy
import ctypes
from collections.abc import Iterable, Sequence
from functools import cached_property, lru_cache

import mujoco
import numpy as np
from mujoco import _batch
from mujoco.batch import Batch
from numpy.typing import ArrayLike, NDArray

from jbrep.envs.environments import check_counts
from jbrep.envs.physics import put_factors, turned, turned_quaternion, velocity_after
from jbrep.envs.task import Array
from jbrep.jitterbug import bodies, tasks

PHYSICS_TIMESTEP = 0.0002  # [s]
PHYSICS_STEPS = round(tasks.CONTROL_TIMESTEP / PHYSICS_TIMESTEP)  # in a control step
_ARENA = 1 << 20  # [bytes] per robot; MuJoCo's own choice is 14 times as large
_UP_TO_VELOCITIES = int(mujoco.mjtStage.mjSTAGE_VEL)
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
# on a position, velocity or acceleration that isn't finite, MuJoCo warns and resets the robot
_NOT_FINITE = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1
)


def plain_model(body: bodies.Body | None = None) -> mujoco.MjModel:
    """The model as described; without a body, the published robot's."""
    return _read_spec(body).compile()


@lru_cache(maxsize=256)
def fast_model(body: bodies.Body | None = None) -> mujoco.MjModel:
    """The model with only the contacts that occur; trajectories are bit-identical.

    Listing the pairs of robot and floor avoids the search for others, and a single robot needs no
    constraint islands. Without textures a model takes 30 kB in place of 1.4 MB, and a tenth of the
    time to compile. The model is shared: don't change it.
    """
    spec = _read_spec(body)
    for texture in spec.textures:
        texture.width = texture.height = 1
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    touching = [geom for geom in spec.geoms if geom.contype and geom.name != "floor"]
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    spec.memory = _ARENA
    for geom in touching:
        spec.add_pair(name=geom.name, geomname1="floor", geomname2=geom.name)
    return spec.compile()


def _read_spec(body: bodies.Body | None) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(bodies.read_xml())
    if body is not None:
        body.reshape(spec)
    return spec


def stop_profiling() -> None:
    """Turn off MuJoCo's profiling clock, read at every stage, in this process.

    `mjData.timer` then stays zero; nothing else changes. If the symbol can't be found, the clock
    stays on.
    """
    try:
        clock = ctypes.c_void_p.in_dll(ctypes.CDLL(_batch.__file__), "mjcb_time")
    except (OSError, ValueError):
        return
    clock.value = None


class Simulation:
    """n Jitterbugs; what each does depends on its own start and actions alone.

    Neither their number nor that of threads changes a bit of any trajectory.

    Args:
        task: what is observed and rewarded.
        num_envs: n, the number of robots.
        num_threads: threads to step them on; None takes one for each core.
        body: number of the robots' body, 0 to 2^31 - 1, "random" for another in each episode, or
            None for the published robot's; see `jbrep.jitterbug.bodies`.
        materials: bodies differ in their densities and the motor's gear, too.

    Attributes:
        readings: what the tasks read of the current states; a new object after each step.
        target_quaternion: of the robots' targets, (n, 4).
    """

    def __init__(
        self,
        task: tasks.JitterbugTask,
        num_envs: int,
        num_threads: int | None = None,
        body: int | str | None = None,
        materials: bool = False,
    ):
        check_counts(num_envs, num_threads)
        bodies.check_body(body, materials)
        stop_profiling()
        self.task = task
        self.num_envs = num_envs
        self._body = body
        self._materials = materials
        first = body if isinstance(body, int) else bodies.PUBLISHED
        self._numbers = np.full(num_envs, first, np.int64)
        self._factors = np.ones((num_envs, 2))  # of friction and mass
        self._models = [fast_model(self._drawn(first))] * num_envs
        self._shown: dict[tuple[float, ...], mujoco.MjModel] = {}
        # persistent: a step reuses what has already been computed for the readings
        self._batch = Batch(self._models[0], num_envs, num_threads or 0, persistent=True)
        self._control = self._batch.bind("ctrl")
        core = self._models[0].body("jitterbug").id
        self._warnings = self._batch.warning[:, _NOT_FINITE, 1]
        self._views = (
            self._batch.bind("qpos"),
            self._batch.bind("qvel"),
            self._batch.bind("xmat")[:, core],
            self._batch.bind("sensordata"),
            self._batch.bind("mocap_pos")[:, 0],
            np.zeros((num_envs, 2)),
        )
        self.target_quaternion = self._batch.bind("mocap_quat")[:, 0]
        self._warmstart = self._batch.bind("qacc_warmstart")
        self.readings = tasks.Readings(*self._views)

    def reset(
        self,
        indices: Sequence[int],
        randoms: Iterable[np.random.Generator],
        numbers: Iterable[float] | None = None,
        factors: ArrayLike = 1.0,
    ) -> None:
        """Start an episode of each of k robots, drawn from its own generator.

        A random body doesn't change what else is drawn from the generator, now or later. Numbers,
        (k,), are those of other bodies than that of all; factors, (k, 2), of friction and mass.
        """
        randoms = list(randoms)
        if numbers is None:
            numbers = [bodies.number_of(self._body, random) for random in randoms]
        self._put_models(indices, numbers, np.broadcast_to(factors, (len(indices), 2)))
        self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
        for index, random in zip(indices, randoms, strict=True):
            start = self.task.start(random)
            self.readings.qpos[index, tasks.QUATERNION] = start.quaternion
            self.readings.target_position[index] = start.target_position
            self.target_quaternion[index] = start.target_quaternion
        self._forward(indices)

    @property
    def body_numbers(self) -> Array:
        """The number of each robot's body, -1 for the published one, (n,)."""
        return self._numbers.astype(np.float64)

    @property
    def state(self) -> dict[str, Array]:
        now = self.readings
        state = {
            "qpos": now.qpos.copy(),
            "qvel": now.qvel.copy(),
            "target_position": now.target_position.copy(),
            "target_quaternion": self.target_quaternion.copy(),
            "warmstart": self._warmstart.copy(),
        }
        if self._body is not None or (self._numbers != bodies.PUBLISHED).any():
            state["body"] = self.body_numbers
        if (self._factors != 1).any():
            state["factors"] = self._factors.copy()
        return state

    @property
    def mujoco_state(self) -> dict[str, Array]:
        """What pictures follow from: views of `mujoco.MjData`, (n, ...) each."""
        return {
            "qpos": self.readings.qpos,
            "qvel": self.readings.qvel,
            "ctrl": self._control,
            "mocap_pos": self.readings.target_position[:, None],
            "mocap_quat": self.target_quaternion[:, None],
        }

    def restore(
        self,
        qpos: Array,
        qvel: Array,
        target_position: Array,
        target_quaternion: Array,
        warmstart: ArrayLike = 0.0,
        body: Array | None = None,
        factors: Array | None = None,
    ) -> None:
        """Put all robots in stored states: (n, 16), (n, 15), (n, 3) and (n, 4).

        The same actions then lead through the same states, bit for bit. After an episode's first
        state this also takes the warm start (n, 15) of MuJoCo's solver. `body` holds the numbers
        of the bodies (n,), -1 for the published robot's, and `factors` those of friction and mass,
        (n, 2); without them, the robots keep theirs.
        """
        indices = range(self.num_envs)
        kept = self._numbers.copy() if body is None else body
        self._put_models(indices, kept, self._factors.copy() if factors is None else factors)
        self._batch.reset(indices, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.readings.qpos[:] = qpos
        self.readings.qvel[:] = qvel
        self.readings.target_position[:] = target_position
        self.target_quaternion[:] = target_quaternion
        self._warmstart[:] = warmstart
        self._forward(indices)

    def quarter_turn(self, shift: tuple[float, float]) -> None:
        """Turn robots and targets by a quarter about the vertical axis, then shift them [m]."""
        state = self.state
        for name in ("qpos", "target_position"):
            state[name][:, :2] = turned(state[name][:, :2]) + shift
        for name in ("qvel", "warmstart"):
            state[name][:, :2] = turned(state[name][:, :2])
        for quaternion in (state["qpos"][:, tasks.QUATERNION], state["target_quaternion"]):
            quaternion[:] = turned_quaternion(quaternion)
        self.restore(**state)

    def _drawn(self, number: int) -> bodies.Body | None:
        return None if number == bodies.PUBLISHED else bodies.draw(number, self._materials)

    def _put_models(self, indices: Sequence[int], numbers: Iterable[float], factors: Array) -> None:
        changed = False
        for index, number, own in zip(indices, numbers, factors, strict=True):
            if number != self._numbers[index] or (own != self._factors[index]).any():
                self._numbers[index], self._factors[index] = number, own
                usual = fast_model(self._drawn(int(number)))
                self._models[index] = self._varied(index, usual, self._scratch)
                changed = True
        if changed:
            self._batch.set_models(self._models)
            self._shown.clear()

    def _varied(self, index: int, usual: mujoco.MjModel, data: mujoco.MjData) -> mujoco.MjModel:
        """The usual model of a robot's body with its factors; itself where they are 1."""
        friction, mass = self._factors[index].tolist()
        if friction == mass == 1:
            return usual
        varied = copy.copy(usual)
        put_factors(varied, usual, friction, mass, data)
        return varied

    @cached_property
    def _scratch(self) -> mujoco.MjData:
        return mujoco.MjData(self._models[0])

    def push(self, velocity: Array) -> None:
        """Push robots: by the impulse on each one's core by its mass, (n, 3) [m/s]; 0 is none."""
        indices = np.flatnonzero(velocity.any(axis=1)).tolist()
        for index in indices:
            now, scratch = self.readings.qpos[index], self._scratch
            added = velocity_after(self._models[index], now, velocity[index], scratch)
            self.readings.qvel[index] += added
        self._forward(indices)

    def _forward(self, indices: Sequence[int]) -> None:
        self.readings.target_axis[:] = tasks.yaw_direction(self.target_quaternion)
        self._batch.forward(indices, stage=_UP_TO_VELOCITIES)
        self.readings = tasks.Readings(*self._views)

    def step(self, action: Array) -> NDArray[np.bool_]:
        """Hold the actions (n, 1) for a control step; whether each robot has diverged so far, (n,).

        Such a robot and its target were put in their default states, and its episode has ended.
        """
        self._control[:] = action
        self._batch.step(nstep=PHYSICS_STEPS, stage=_UP_TO_VELOCITIES)
        self.readings = tasks.Readings(*self._views)
        return self._warnings.any(axis=1)

    def observe(self) -> Array:
        """The observations in physical units, (n, d)."""
        return self.task.observe(self.readings)

    def reward(self) -> Array:
        """The rewards of the current states, (n,)."""
        return self.task.reward(self.readings)

    def model_of(self, index: int) -> mujoco.MjModel:
        """The model of a robot as described, with its factors; a new one once it differs."""
        number = int(self._numbers[index])
        key = (number, *self._factors[index].tolist())
        if key not in self._shown:
            usual = plain_model(self._drawn(number))
            self._shown[key] = self._varied(index, usual, mujoco.MjData(usual))
        return self._shown[key]

    def copy_data(self, index: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """A robot as a MuJoCo data object of `model_of(index)`, to render or inspect."""
        shown = self.model_of(index)
        data = data or mujoco.MjData(shown)
        mujoco.mj_setState(shown, data, self._batch.state[index], _STATE)
        mujoco.mj_forward(shown, data)
        return data
