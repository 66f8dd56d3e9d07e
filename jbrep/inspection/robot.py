"""A robot of any MuJoCo model as Rerun entities, one for each body."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion, root_of
from jbrep.envs.task import Array
from jbrep.inspection.recording import Recording
from jbrep.inspection.shapes import XYZW, is_shown, own_colours, shapes

_DEFAULT_SIZE = 1.0  # [m] of a model without geoms


def rotate(quaternion: Array, vector: Array) -> Array:
    """Vectors (..., 3) rotated by quaternions (..., 4)."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    across = np.cross(axis, vector)
    return vector + 2 * (scalar * across + np.cross(axis, across))


class Poses(NamedTuple):
    """Where the bodies of a model are in n states, in the world."""

    position: Array  # (n, bodies, 3) [m]
    quaternion: Array  # (n, bodies, 4)


class Robot:
    """The bodies of a model, and which of them are the robot.

    That is the heaviest tree of bodies that can move; all of them where none can.

    Attributes:
        model: the MuJoCo model.
        names: of all bodies as parts of paths, each a different one.
        root: number of the body that carries the robot's others.
        bodies: numbers of the robot's bodies, the root first.
        others: numbers of all other bodies, such as the world and a target.
        place: of the root in the model's reference pose, (3,) [m].
        size: from the root's origin to the farthest point of the robot, in the same pose [m].
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.names = _names(model)
        self.root = root_of(model)
        roots = model.body_rootid if self.root else np.zeros(model.nbody, int)
        self.bodies = np.flatnonzero(roots == self.root).tolist()
        self.others = np.flatnonzero(roots != self.root).tolist()
        self.place, self.size = self._reach()

    @property
    def weight(self) -> float:
        """The robot's weight [N]."""
        gravity = float(np.linalg.norm(self.model.opt.gravity))
        return float(self.model.body_subtreemass[self.root]) * gravity

    def _reach(self) -> tuple[Array, float]:
        data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, data)
        geoms = [g for body in self.bodies for g in self.geoms(body)]
        away = np.linalg.norm(data.geom_xpos[geoms] - data.xpos[self.root], axis=1)
        size = float((away + self.model.geom_rbound[geoms]).max(initial=0)) or _DEFAULT_SIZE
        return data.xpos[self.root].copy(), size

    def geoms(self, body: int) -> list[int]:
        """Numbers of a body's geoms that can be drawn."""
        address, count = self.model.body_geomadr[body], self.model.body_geomnum[body]
        return [g for g in range(address, address + count) if is_shown(self.model, g)]

    def poses(self, motion: Motion) -> Poses:
        """Where all bodies are in each state."""
        data = mujoco.MjData(self.model)
        position = np.empty((len(motion), self.model.nbody, 3))
        quaternion = np.empty((len(motion), self.model.nbody, 4))
        for state in range(len(motion)):
            motion.put(data, state)
            mujoco.mj_kinematics(self.model, data)
            position[state], quaternion[state] = data.xpos, data.xquat
        return Poses(position, quaternion)

    def draw(
        self,
        recording: Recording,
        root: str,
        times: Sequence[rr.TimeColumn],
        poses: Poses,
        bodies: Iterable[int],
        colours: NDArray[np.uint8] | None = None,
    ) -> None:
        """Draw bodies as entities below another.

        Args:
            recording: to draw in.
            root: the entity.
            times: of the states.
            poses: of all bodies in n states.
            bodies: numbers of those to draw.
            colours: of each of them in each state, (n, len(bodies), 4), or of all, (4,); their
                own if not given.
        """
        for i, body in enumerate(bodies):
            geoms, columns = self.geoms(body), []
            if colours is None or colours.ndim == 1:
                own = own_colours(self.model, geoms)
                fixed = own if colours is None else np.tile(colours, (len(geoms), 1))
                static: list[Any] = shapes(self.model, geoms, fixed)
            else:
                static = shapes(self.model, geoms, None)
                columns = [type(shape).columns(colors=colours[:, i]) for shape in static]
            place, turned = poses.position[:, body], poses.quaternion[:, body][:, XYZW]
            if (place == place[0]).all() and (turned == turned[0]).all():
                still = rr.Quaternion(xyzw=turned[0])
                static.append(rr.Transform3D(translation=place[0], quaternion=still))
            else:
                columns.append(rr.Transform3D.columns(translation=place, quaternion=turned))
            path = f"{root}/{self.names[body]}"
            if static:
                recording.send(path, *static)
            if columns:
                recording.send_columns(path, times, *columns)


def _names(model: mujoco.MjModel) -> list[str]:
    """Names of the bodies as parts of paths, numbered where they have none or not their own."""
    names: list[str] = []
    for body in range(model.nbody):
        name = re.sub(r"[^A-Za-z0-9_.-]", "_", model.body(body).name) or f"body_{body}"
        names.append(name if name not in names else f"{name}_{body}")
    return names
