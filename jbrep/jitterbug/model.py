"""The Jitterbug's MuJoCo model: as described, and the same robot compiled to step faster."""

import ctypes
from functools import lru_cache

import mujoco
from mujoco import _batch

from jbrep.jitterbug.bodies import Body, read_xml
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP

PHYSICS_TIMESTEP = 0.0002  # [s]
PHYSICS_STEPS = round(CONTROL_TIMESTEP / PHYSICS_TIMESTEP)  # in a control step
_ARENA = 1 << 20  # [bytes] per robot; MuJoCo's own choice is 14 times as large


def plain_model(body: Body | None = None) -> mujoco.MjModel:
    """The model as described; without a body, the published robot's."""
    return _read_spec(body).compile()


@lru_cache(maxsize=256)
def fast_model(body: Body | None = None) -> mujoco.MjModel:
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


def _read_spec(body: Body | None) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(read_xml())
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
