"""The robot as a tree of Rerun entities, named as in its MuJoCo model."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.inspection.recording import Recording
from jbrep.jitterbug.model import plain_model
from jbrep.jitterbug.tasks import Array

ROOT = "jitterbug"
_XYZW = [1, 2, 3, 0]  # Rerun's order of a quaternion's components, from MuJoCo's


def rotate(quaternion: Array, vector: Array) -> Array:
    """Vectors (..., 3) rotated by quaternions (..., 4)."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    across = np.cross(axis, vector)
    return vector + 2 * (scalar * across + np.cross(axis, across))


def multiply(first: Array, second: Array) -> Array:
    """Products (..., 4) of quaternions: the rotation by the second, then by the first."""
    scalar, axis = first[..., :1], first[..., 1:]
    other, along = second[..., :1], second[..., 1:]
    real = scalar * other - (axis * along).sum(-1, keepdims=True)
    return np.concatenate((real, scalar * along + other * axis + np.cross(axis, along)), axis=-1)


def transform(position: Array, quaternion: Array) -> rr.ComponentColumnList:
    """Positions (n, 3) and quaternions (n, 4) as columns."""
    return rr.Transform3D.columns(translation=position, quaternion=quaternion[:, _XYZW])


class Robot:
    """Bodies and geoms of the model, and their poses in a state.

    Attributes:
        model: the MuJoCo model.
        bodies: names of the robot's bodies, each after its parent.
    """

    def __init__(self) -> None:
        self.model = plain_model()
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        self.bodies = tuple(names[names.index(ROOT) :])

    @cached_property
    def paths(self) -> dict[str, str]:
        """The path of each body's entity, from the root's."""
        paths = {ROOT: ROOT}
        for name in self.bodies[1:]:
            paths[name] = f"{paths[self._parent(name)]}/{name}"
        return paths

    def _parent(self, body: str) -> str:
        return self.model.body(self.model.body(body).parentid[0]).name

    def poses(self, qpos: Array) -> dict[str, tuple[Array, Array]]:
        """The pose of each body in its parent's frame, the root's in the world.

        Args:
            qpos: n states, (n, 16).

        Returns:
            Positions (n, 3) and quaternions (n, 4).
        """
        poses = {ROOT: (qpos[:, :3], qpos[:, 3:7])}
        for name in self.bodies[1:]:  # each turns about an axis through its origin
            body = self.model.body(name)
            joint = self.model.joint(body.jntadr[0])
            half = qpos[:, joint.qposadr] / 2
            turned = np.concatenate((np.cos(half), np.sin(half) * joint.axis), axis=1)
            poses[name] = np.tile(body.pos, (len(qpos), 1)), turned
        return poses

    def origins(self, qpos: Array) -> dict[str, Array]:
        """The position of each body in the world, (n, 3), in states (n, 16)."""
        poses = self.poses(qpos)
        world = {ROOT: poses[ROOT]}
        for name in self.bodies[1:]:
            (origin, turned), (position, quaternion) = world[self._parent(name)], poses[name]
            world[name] = origin + rotate(turned, position), multiply(turned, quaternion)
        return {name: position for name, (position, _) in world.items()}

    def draw(
        self,
        recording: Recording,
        root: str,
        times: Sequence[rr.TimeColumn],
        qpos: Array,
        colours: Mapping[str, NDArray[np.uint8]] | None = None,
        still: Sequence[str] = (),
    ) -> None:
        """Draw the robot below an entity.

        Args:
            recording: to draw in.
            root: the entity.
            times: of the states.
            qpos: the states, (n, 16).
            colours: of each body, (n, 4), or (4,) at all times; the materials' if not given.
            still: bodies that don't move relative to their parents.
        """
        for name, (position, quaternion) in self.poses(qpos).items():
            path, columns = f"{root}/{self.paths[name]}", []
            if name in still:
                turned = rr.Quaternion(xyzw=quaternion[0, _XYZW])
                recording.send(path, rr.Transform3D(translation=position[0], quaternion=turned))
            else:
                columns.append(transform(position, quaternion))
            if colours is None:
                self.draw_geoms(recording, path, name)
            else:
                columns += self._draw_merged(recording, path, name, colours[name])
            if columns:
                recording.send_columns(path, times, *columns)

    def draw_geoms(self, recording: Recording, path: str, body: str) -> None:
        """Draw a body's geoms as entities below its own, in their materials' colours."""
        for geom in self._geoms(body):
            colour = np.round(255 * self.model.mat_rgba[geom.matid[0]]).astype(np.uint8)
            shape = _kind(geom).from_fields(**_fields([geom]), colors=[colour])
            recording.send(f"{path}/{geom.name}", shape)

    def _draw_merged(
        self, recording: Recording, path: str, body: str, colours: NDArray[np.uint8]
    ) -> list[rr.ComponentColumnList]:
        """Draw a body's geoms on its own entity, which takes less space.

        Returns:
            Their colours as columns, if they change.
        """
        kinds = defaultdict(list)
        for geom in self._geoms(body):
            kinds[_kind(geom)].append(geom)
        still = {"colors": [colours]} if colours.ndim == 1 else {}
        for kind, geoms in kinds.items():
            recording.send(path, kind.from_fields(**_fields(geoms), **still))
        return [] if still else [kind.columns(colors=colours) for kind in kinds]

    def _geoms(self, body: str) -> list[Any]:
        address, count = self.model.body(body).geomadr[0], self.model.body(body).geomnum[0]
        return [self.model.geom(address + i) for i in range(count)]


def _kind(geom: Any) -> Any:
    """Rerun's archetype for a geom."""
    kinds = {mujoco.mjtGeom.mjGEOM_BOX: rr.Boxes3D, mujoco.mjtGeom.mjGEOM_CYLINDER: rr.Cylinders3D}
    return kinds.get(mujoco.mjtGeom(geom.type[0]), rr.Ellipsoids3D)


def _fields(geoms: Sequence[Any]) -> dict[str, Any]:
    """All fields of an archetype but its colours, for geoms of one kind."""
    sizes = np.array([geom.size for geom in geoms])
    fields = {
        "quaternions": [geom.quat[_XYZW] for geom in geoms],
        "centers": [geom.pos for geom in geoms],
        "fill_mode": rr.components.FillMode.Solid,
    }
    if _kind(geoms[0]) is rr.Cylinders3D:
        return {**fields, "radii": sizes[:, 0], "lengths": 2 * sizes[:, 1]}
    is_sphere = [geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE for geom in geoms]
    return {**fields, "half_sizes": np.where(np.transpose([is_sphere]), sizes[:, :1], sizes)}
