"""MuJoCo behind an environment: its model and data, and what its state goes through."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from jbrep.envs.lanes import Lanes
from jbrep.envs.mujoco import physics_of
from jbrep.envs.recording import Recording
from jbrep.envs.task import Array

# of an MjData: what a picture and the contact forces of a state follow from
_STATE = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")


@dataclass(frozen=True, eq=False)
class Motion:
    """The n states of MuJoCo that a robot went through.

    Args:
        model: the robot and its surroundings.
        arrays: of `mujoco.MjData`, (n, ...) each; those left out are as in a new one. `ctrl` is
            what was held in the step that led to a state.
    """

    model: mujoco.MjModel
    arrays: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.qpos)

    @property
    def qpos(self) -> Array:
        """Positions of the joints, (n, nq)."""
        return self.arrays["qpos"]

    @property
    def qvel(self) -> Array:
        """Velocities of the joints, (n, nv)."""
        return self.arrays["qvel"]

    def put(self, data: mujoco.MjData, state: int) -> None:
        """Set a data object to one of the states; nothing is computed from it."""
        for name, values in self.arrays.items():
            getattr(data, name)[:] = values[state]


class MotionReader:
    """Reads the physics of lanes while `jbrep.envs.recording.record` plays their next episodes.

    Known are the environments of `physics_of`, and batches that give the `models` of their lanes
    and their `mujoco_state`, arrays of `mujoco.MjData` by name, (n, ...) each.
    """

    def __init__(self) -> None:
        self._models: list[mujoco.MjModel] = []

    def __call__(self, lanes: Lanes) -> Mapping[str, Array]:
        """The state of each lane, (n, ...) each; nothing where there is no MuJoCo."""
        if hasattr(lanes.envs, "mujoco_state"):
            self._models = self._models or lanes.envs.models
            return lanes.envs.mujoco_state
        running = [physics_of(env) for env in lanes.envs] if isinstance(lanes.envs, list) else []
        every = [physics for physics in running if physics]
        if len(every) < lanes.num_lanes or len({p.model.nq for p in every}) > 1:
            return {}
        self._models = self._models or [physics.model for physics in every]
        return {name: np.stack([getattr(p.data, name) for p in every]) for name in _STATE}

    def motion(self, recording: Recording, lane: int, steps: int) -> Motion | None:
        """What the robot of a lane went through in its first steps; None without MuJoCo."""
        if not recording.arrays:
            return None
        read = recording.arrays.items()
        return Motion(self._models[lane], {n: values[: steps + 1, lane] for n, values in read})
