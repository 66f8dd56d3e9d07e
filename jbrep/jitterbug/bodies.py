"""Other bodies of the Jitterbug: the same robot, built with less precision.

A body is drawn by number: knees, feet and hinge axes, the weight, and where asked the materials.
The spreads are those of the robot's authors. They let the weight strike a leg in one body of ten;
a body whose weight comes within half a millimetre of a leg is drawn again.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import resources
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jbrep.envs.task import Array
from jbrep.errors import InputError

RANDOM = "random"  # another body in each episode
PUBLISHED = -1  # the number of the published robot, which isn't drawn
_NUMBERS = 2**31
_STREAM = 0x626F6479  # nothing else draws from the streams (_STREAM, number)

_LEG_SD = (0.003, 0.003, 0.002)  # of each knee and foot [m]
_WEIGHT_SD = (0.0015, 0.002, 0.001)  # of the weight's place [m]
_WEIGHT_LOWEST = (-np.inf, -0.001, -0.001)  # shift of its place [m]
_SIZE_SD, _SIZE_LOWEST = 0.0007, -0.002  # change of its semi-axes, 3 mm and more [m]
_DENSITY_SD = {38.5: 10.0, 770.0: 80.0, 7700.0: 200.0}  # by the published density [kg/m^3]
_DENSITY_LOWEST = 0.1  # share of the published density
_GEAR_SD = 0.001
_CLEARANCE = 0.0005  # between the weight's orbit and a leg [m]
_LEGS = ("leg1", "leg2", "leg3", "leg4")


def read_xml() -> str:
    """The MJCF text of the published robot."""
    return resources.files(__package__).joinpath("jitterbug.xml").read_text()


@dataclass(frozen=True)
class Body:
    """How a body differs from the published one in the default pose: what is added to that."""

    number: int  # what it is drawn from
    materials: bool  # whether densities and gear are drawn, too
    knees: Array = field(compare=False, repr=False)  # of legs 1 to 4, (4, 3) [m]
    feet: Array = field(compare=False, repr=False)  # likewise
    weight: Array = field(compare=False, repr=False)  # to its place, (3,) [m]
    weight_size: float = field(compare=False, repr=False)  # to its three semi-axes [m]
    densities: Array = field(compare=False, repr=False)  # to 38.5, 770 and 7,700, (3,) [kg/m^3]
    gear: float = field(compare=False, repr=False)  # to the motor's

    def reshape(self, spec: mujoco.MjSpec) -> None:
        """Turn the published robot into this one.

        The default pose is raised or lowered until the lowest foot touches the floor again. Weight
        and legs pass through each other, should a hard blow bend a leg that far.
        """
        for leg, knee, foot in zip(_LEGS, self.knees, self.feet, strict=True):
            _reshape_leg(spec, leg, knee, foot)
            spec.add_exclude(bodyname1="weight", bodyname2=f"{leg}_upper")
        weight = spec.geom("weight")
        weight.pos = weight.pos + self.weight
        weight.size = weight.size + self.weight_size
        densities = dict(zip(_DENSITY_SD, self.densities, strict=True))
        for geom in spec.geoms:
            geom.density += densities.get(geom.density, 0)
        motor = spec.actuator("motor")
        motor.gear = motor.gear + np.append(self.gear, np.zeros(5))
        core = spec.body("jitterbug")
        core.pos = core.pos - [0, 0, min(_height(spec, leg) for leg in _LEGS)]

    def strikes(self) -> bool:
        """Whether the weight comes within 0.5 mm of a leg on its way round, at rest."""
        published = _published()
        knees = published.knees + self.knees
        share = np.linspace(0, 1, 100)[:, None, None]
        rods = published.hips + share * (knees - published.hips)  # (100, 4, 3)
        centre = published.weight + self.weight
        reach = published.size + self.weight_size + published.rod + _CLEARANCE
        out = np.hypot(rods[..., 0], rods[..., 1]) - np.hypot(*centre[:2])
        up = rods[..., 2] - centre[2]
        return bool(((np.maximum(out, 0) / reach[:2].max()) ** 2 + (up / reach[2]) ** 2 < 1).any())


def draw(number: int, materials: bool = False) -> Body:
    """The body of a number, 0 to 2^31 - 1, the same each time; its shape with any materials."""
    random = np.random.default_rng((_STREAM, number))
    body = _draw(number, random)
    while body.strikes():
        body = _draw(number, random)
    if not materials:
        return body
    published = np.array(list(_DENSITY_SD))
    densities = random.normal(0, list(_DENSITY_SD.values()))
    densities = np.maximum(densities, (_DENSITY_LOWEST - 1) * published)
    return replace(body, materials=True, densities=densities, gear=random.normal(0, _GEAR_SD))


def _draw(number: int, random: np.random.Generator) -> Body:
    return Body(
        number,
        materials=False,
        knees=random.normal(0, _LEG_SD, (4, 3)),
        feet=random.normal(0, _LEG_SD, (4, 3)),
        weight=np.maximum(random.normal(0, _WEIGHT_SD), _WEIGHT_LOWEST),
        weight_size=max(random.normal(0, _SIZE_SD), _SIZE_LOWEST),
        densities=np.zeros(len(_DENSITY_SD)),
        gear=0.0,
    )


def check_body(body: Any, materials: Any) -> None:
    """Check the choice of a body: a number, "random", or None for the published robot."""
    if type(materials) is not bool:
        raise InputError(f"materials is {materials!r}: it must be true or false")
    if body is None or body == RANDOM:
        return
    if type(body) is not int or not 0 <= body < _NUMBERS:
        raise InputError(
            f"body is {body!r}: it must be a whole number from 0 to {_NUMBERS - 1}, or "
            f"{RANDOM!r} for another in each episode; without one, it is the published robot's"
        )


def number_of(body: int | str | None, random: np.random.Generator) -> int:
    """The number of the body of an episode, PUBLISHED for the published robot.

    A random one follows from the state of the episode's generator, but leaves it as it is.
    """
    if body is None:
        return PUBLISHED
    if isinstance(body, int):
        return body
    apart: Any = random.bit_generator
    return int(np.random.Generator(apart.jumped()).integers(_NUMBERS))


def _reshape_leg(spec: mujoco.MjSpec, leg: str, knee: Array, foot: Array) -> None:
    """Shift a knee and a foot (3,) and turn the hinges to the new leg.

    An axis points to the side to which the published one does, so that angles keep their signs.
    """
    below = foot - knee  # in the frame of the lower leg, which moves with the knee
    upper, lower = spec.geom(f"{leg}_upper"), spec.geom(f"{leg}_lower")
    upper.fromto = upper.fromto + np.append(knee, np.zeros(3))
    lower.fromto = lower.fromto + np.append(below, np.zeros(3))
    for part, shift in (
        (spec.geom(f"{leg}_knee"), knee),
        (spec.body(f"{leg}_lower"), knee),
        (spec.geom(f"{leg}_foot"), below),
    ):
        part.pos = part.pos + shift
    along_upper, along_lower = (rod.fromto[:3] - rod.fromto[3:] for rod in (upper, lower))
    shoulder, elbow = spec.joint(f"{leg}_shoulder"), spec.joint(f"{leg}_elbow")
    for hinge, across in ((shoulder, np.array([0, 0, 1])), (elbow, along_lower)):
        axis = np.cross(along_upper, across)
        hinge.axis = axis * np.sign(axis @ hinge.axis)


def _height(spec: mujoco.MjSpec, leg: str) -> float:
    """Height of the lowest point of a foot above the floor in the default pose [m]."""
    chain = [spec.body("jitterbug"), spec.body(f"{leg}_upper"), spec.body(f"{leg}_lower")]
    foot = spec.geom(f"{leg}_foot")
    return float(sum(part.pos[2] for part in [*chain, foot]) - foot.size[0])


class _Published(NamedTuple):
    """The published upper legs and weight, in the motor's frame."""

    hips: Array  # inner ends of the upper legs, (4, 3)
    knees: Array  # their outer ends, (4, 3)
    rod: float  # their radius
    weight: Array  # its centre, (3,)
    size: Array  # its semi-axes, (3,)


@lru_cache(maxsize=1)
def _published() -> _Published:
    spec = mujoco.MjSpec.from_string(read_xml())
    rods = [spec.geom(f"{leg}_upper") for leg in _LEGS]
    frames = np.array([rod.parent.pos for rod in rods]) - spec.body("weight").pos
    ends = np.array([rod.fromto for rod in rods])
    weight = spec.geom("weight")
    return _Published(
        frames + ends[:, 3:],
        frames + ends[:, :3],
        float(rods[0].size[0]),
        weight.pos.copy(),
        weight.size.copy(),
    )
