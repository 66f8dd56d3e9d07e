"""The geoms of a MuJoCo model in Rerun's terms."""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.envs.task import Array

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


def is_shown(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is visible and of a kind that `shapes` knows; height fields aren't."""
    seen = model.geom_group[geom] < _SHOWN_GROUPS and _colour_of(model, geom)[3] > 0
    return bool(seen) and int(model.geom_type[geom]) in _KINDS


def own_colours(model: mujoco.MjModel, geoms: Sequence[int]) -> NDArray[np.uint8]:
    """The colours that the model gives to geoms, (len(geoms), 4)."""
    return np.reshape([_colour_of(model, geom) for geom in geoms], (-1, 4)).astype(np.uint8)


def _colour_of(model: mujoco.MjModel, geom: int) -> NDArray[np.uint8]:
    """A geom's colour, (4,): its own, or its material's as in MuJoCo; textures are left out."""
    rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(rgba, _NO_COLOUR):
        rgba = model.mat_rgba[material]
    return np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)


def shapes(
    model: mujoco.MjModel, geoms: Sequence[int], colours: NDArray[np.uint8] | None
) -> list[Any]:
    """Geoms of one body in its frame, as an archetype for each of their kinds.

    Args:
        model: the model.
        geoms: their numbers; each must be one that `is_shown`.
        colours: of each geom, (len(geoms), 4); none if not given.
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
    """Sizes and poses of geoms of one kind."""
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
    """Rotations of geoms in their bodies' frames, (len(geoms), 3, 3)."""
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
