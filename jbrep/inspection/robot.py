"""A robot of any MuJoCo model as Rerun entities: one for each body, of the shapes of its geoms."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.physics import Motion, root_of
from jbrep.envs.task import Array
from jbrep.inspection.recording import Recording

_ROUNDING = 1e-9  # [m], and of a quaternion
_DEFAULT_SIZE = 1.0  # [m] of a model without geoms
XYZW = [1, 2, 3, 0]  # Rerun's order of a quaternion's components, from MuJoCo's
_SHOWN_GROUPS = 3  # of geoms: MuJoCo's viewers hide those from here on, used for collisions
_NO_COLOUR = (0.5, 0.5, 0.5, 1)  # what a geom has if none is given: its material's holds
_SOLID = rr.components.FillMode.Solid
_KINDS: dict[int, Any] = {
    mujoco.mjtGeom.mjGEOM_SPHERE: rr.Ellipsoids3D,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: rr.Ellipsoids3D,
    mujoco.mjtGeom.mjGEOM_CAPSULE: rr.Capsules3D,
    mujoco.mjtGeom.mjGEOM_CYLINDER: rr.Cylinders3D,
    mujoco.mjtGeom.mjGEOM_BOX: rr.Boxes3D,
    mujoco.mjtGeom.mjGEOM_MESH: rr.Mesh3D,
}


class Poses(NamedTuple):
    """Where the bodies of a model are in n states."""

    position: Array  # (n, bodies, 3) [m]
    quaternion: Array  # (n, bodies, 4)


class Robot:
    """The bodies of a model, and which of them are the robot.

    That is the heaviest tree of bodies that can move; all of them where none can.

    Attributes:
        model: the MuJoCo model.
        colours: of all geoms, (geoms, 4).
        names: of all bodies as parts of paths, each a different one.
        root: number of the body that carries the robot's others.
        bodies: numbers of the robot's bodies, the root first.
        others: numbers of all other bodies, such as the world and a target.
        place: of the root in the model's reference pose, (3,) [m].
        size: from the root's origin to the farthest point of the robot, in the same pose [m].
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.colours = _colours(model)
        self._shown = (model.geom_group < _SHOWN_GROUPS) & (self.colours[:, 3] > 0)
        self._shown &= np.isin(model.geom_type, [*_KINDS])
        self.names = _names(model)
        self.root = root_of(model)
        roots = model.body_rootid if self.root else np.zeros(model.nbody, int)
        self.bodies = np.flatnonzero(roots == self.root).tolist()
        self.others = np.flatnonzero(roots != self.root).tolist()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self.place = data.xpos[self.root].copy()
        geoms = [g for body in self.bodies for g in self.geoms(body)]
        away = np.linalg.norm(data.geom_xpos[geoms] - self.place, axis=1)
        self.size = float((away + model.geom_rbound[geoms]).max(initial=0)) or _DEFAULT_SIZE

    def geoms(self, body: int) -> list[int]:
        """Numbers of a body's geoms that are visible and can be drawn; height fields can't."""
        numbers: list[int] = np.flatnonzero(self._shown & (self.model.geom_bodyid == body)).tolist()
        return numbers

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
        """Draw bodies as entities below `root`; what doesn't move is sent once.

        Poses are of all bodies in n states; colours of each drawn one in each state, (n,
        len(bodies), 4), or their own.
        """
        for i, body in enumerate(bodies):
            geoms, columns = self.geoms(body), []
            own = self.colours[geoms] if colours is None else None
            static: list[Any] = shapes(self.model, geoms, own)
            if colours is not None:
                columns = [type(shape).columns(colors=colours[:, i]) for shape in static]
            path, place = f"{root}/{self.names[body]}", poses.position[:, body]
            turned = poses.quaternion[:, body][:, XYZW]
            if max(np.ptp(place, axis=0).max(), np.ptp(turned, axis=0).max()) < _ROUNDING:
                still = rr.Quaternion(xyzw=turned[0])
                static.append(rr.Transform3D(translation=place[0], quaternion=still))
            else:
                columns.append(rr.Transform3D.columns(translation=place, quaternion=turned))
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


def _colours(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """The geoms' own colours, or their materials' as in MuJoCo; textures are left out."""
    rgba, material = model.geom_rgba.copy(), model.geom_matid
    of_material = (material >= 0) & np.isclose(rgba, _NO_COLOUR).all(axis=1)
    rgba[of_material] = model.mat_rgba[material[of_material]]
    return np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)


def shapes(
    model: mujoco.MjModel, geoms: Sequence[int], colours: NDArray[np.uint8] | None
) -> list[Any]:
    """Geoms of one body in its frame, as an archetype for each of their kinds.

    With a colour for each, (len(geoms), 4), or with none.
    """
    kinds: dict[Any, list[int]] = defaultdict(list)
    for i, geom in enumerate(geoms):
        kinds[_KINDS[int(model.geom_type[geom])]].append(i)
    made = []
    for kind, places in kinds.items():
        some = [geoms[i] for i in places]
        chosen = None if colours is None else colours[places]
        if kind is rr.Mesh3D:
            made.append(_meshes(model, some, chosen))
        else:
            made.append(kind(**_fields(model, kind, some), colors=chosen, fill_mode=_SOLID))
    return made


def _fields(model: mujoco.MjModel, kind: Any, geoms: list[int]) -> dict[str, Any]:
    size, centre = model.geom_size[geoms], model.geom_pos[geoms]
    turned = {"quaternions": model.geom_quat[geoms][:, XYZW]}
    if kind is rr.Cylinders3D:
        return {**turned, "centers": centre, "radii": size[:, 0], "lengths": 2 * size[:, 1]}
    if kind is rr.Capsules3D:  # Rerun's begin at their origin
        begin = centre - size[:, 1:2] * _matrices(model, geoms)[:, :, 2]
        return {**turned, "translations": begin, "radii": size[:, 0], "lengths": 2 * size[:, 1]}
    is_sphere = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_SPHERE
    halves = np.where(is_sphere[:, None], size[:, :1], size)
    return {**turned, "centers": centre, "half_sizes": halves}


def _matrices(model: mujoco.MjModel, geoms: Sequence[int]) -> Array:
    matrices = np.empty((len(geoms), 9))
    for row, geom in zip(matrices, geoms, strict=True):
        mujoco.mju_quat2Mat(row, model.geom_quat[geom])
    return matrices.reshape(-1, 3, 3)


def _meshes(
    model: mujoco.MjModel, geoms: list[int], colours: NDArray[np.uint8] | None
) -> rr.Mesh3D:
    """Meshes as one, of separate triangles, which gives each of them its own normal."""
    parts = []
    for geom, turned in zip(geoms, _matrices(model, geoms), strict=True):
        mesh = model.geom_dataid[geom]
        vertices, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        corners = model.mesh_vert[vertices : vertices + model.mesh_vertnum[mesh]]
        triangles = corners[model.mesh_face[faces : faces + model.mesh_facenum[mesh]]]
        parts.append(triangles @ turned.T + model.geom_pos[geom])
    every = np.concatenate(parts)  # (triangles, 3, 3)
    normals = np.cross(every[:, 1] - every[:, 0], every[:, 2] - every[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    corners_of = [3 * len(part) for part in parts]
    return rr.Mesh3D(
        vertex_positions=every.reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0),
        vertex_colors=None if colours is None else np.repeat(colours, corners_of, axis=0),
    )
