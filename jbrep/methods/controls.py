"""What learns nothing: the whole observation, some of it, noise, random directions and networks."""

from typing import Annotated, ClassVar, Self

import numpy as np
from msgspec import Meta

from jbrep.dataset import ScaledDataset
from jbrep.encoders import FULL
from jbrep.encoders.layers import dense
from jbrep.errors import InputError
from jbrep.methods.linear import linear_code
from jbrep.training.method import ClosedForm, Coded, Made, Network
from jbrep.training.network import get_architecture, layers, stacks
from jbrep.training.settings import Architecture, Names, On, Scaling, Seed

_FREQUENCY = 1000  # [rad] that a phase turns while a scaled feature goes from 0 to 1


class Full(ClosedForm, frozen=True, kw_only=True):
    """The scaled observation itself."""

    name: ClassVar[str] = FULL

    def check(self) -> None:
        super().check()
        if self.on != (own := self.defaults()["on"]):
            raise InputError(f"{self.name} is on {own}: for another, see `kind`")

    def make(self, data: ScaledDataset) -> Made:
        return Made((), ())


class InCoordinates(Full, frozen=True, kw_only=True):
    """The observation in coordinates that fit the robot, scaled.

    Usually by three standard deviations: a velocity's extrema are those of rare shocks.
    """

    name: ClassVar[str] = "coordinates"

    on: On = "coordinates"
    scaling: Scaling = "standard"


class InSymmetry(Full, frozen=True, kw_only=True):
    """Coordinates that shifting and turning the world leaves as they are, scaled."""

    name: ClassVar[str] = "symmetry"

    on: On = "symmetry"
    scaling: Scaling = "standard"


class Subset(ClosedForm, frozen=True, kw_only=True):
    """Some of the features themselves, scaled, in the observation's order."""

    name: ClassVar[str] = "subset"

    features: Annotated[
        Names, Meta(description="Names of features, or patterns such as velocity_*.")
    ]

    def resolved(self, data: ScaledDataset) -> Self:
        """With the names of the features that match the patterns."""
        places = set(data.scaler.places(self.features, data.task))
        each = zip(data.used, data.names, strict=True)
        return self.replace(features=tuple(name for i, name in each if i in places))

    def make(self, data: ScaledDataset) -> Made:
        chosen = [i for i, name in enumerate(data.names) if name in self.features]
        return Made((dense(np.eye(data.size)[chosen], np.zeros(len(chosen))),))


class Noise(Coded, ClosedForm, frozen=True, kw_only=True):
    """The scaled observation, padded to l units with fast sines of it.

    All features pass around the layers; each unit beside them is the sine of a fast phase. An
    encoder draws nothing, so that the noise is of the observation itself: sin(W x + b), with W of
    N(0, 1000^2) and b uniform. From one step to the next, phases turn many times over, so that
    neighbouring values are unrelated. In float32 they are known to about 0.001 only, by which
    libraries may differ.
    """

    name: ClassVar[str] = "noise"
    min_reduction: ClassVar[int | None] = None

    seed: Seed = 0

    def check_data(self, data: ScaledDataset) -> None:
        if self.keep:
            raise InputError("noise keeps all features as they are: leave keep out")
        if self.latent <= data.size:
            raise InputError(
                f"latent size is {self.latent}: with {data.size} features and noise beside them "
                f"it must be at least {data.size + 1}"
            )

    def make(self, data: ScaledDataset) -> Made:
        generator = np.random.default_rng(self.seed)
        shape = self.latent - data.size, data.size
        weight = _FREQUENCY * generator.normal(size=shape)
        phase = generator.uniform(-np.pi, np.pi, size=len(weight))
        nothing = dense(np.zeros(shape[::-1]), np.zeros(data.size))
        return Made((dense(weight, phase, "sin"),), (nothing,), keep=data.names)


class Random(Coded, ClosedForm, frozen=True, kw_only=True):
    """Random orthonormal directions, l of them."""

    name: ClassVar[str] = "random"

    seed: Seed = 0

    def make(self, data: ScaledDataset) -> Made:
        drawn = np.random.default_rng(self.seed).normal(size=(data.size, self.latent))
        directions, triangle = np.linalg.qr(drawn)
        return Made(*linear_code((directions * np.sign(np.diag(triangle))).T, data.moments))


class Untrained(Network, ClosedForm, frozen=True, kw_only=True):
    """The autoencoder's network as it was initialised."""

    name: ClassVar[str] = "untrained"

    architecture: Architecture = "paper"
    seed: Seed = 0

    def make(self, data: ScaledDataset) -> Made:
        architecture = get_architecture(self.architecture)
        encoder, decoder = stacks(architecture, data.size, self.latent, self.seed)
        return Made(layers(encoder), layers(decoder))


class Fourier(Coded, ClosedForm, frozen=True, kw_only=True):
    """Random Fourier features, in which functions of the observation are nearly linear."""

    name: ClassVar[str] = "fourier"
    min_reduction: ClassVar[int | None] = None

    frequency: Annotated[
        float,
        Meta(
            gt=0,
            le=1000,
            description="Standard deviation of what a phase turns while a scaled feature goes from "
            "0 to 1 [rad].",
        ),
    ] = 0.5
    seed: Seed = 0

    def make(self, data: ScaledDataset) -> Made:
        """sin(W x + b), with W of N(0, frequency^2) and b uniform (Rahimi and Recht 2007)."""
        generator = np.random.default_rng(self.seed)
        weight = self.frequency * generator.normal(size=(self.latent, data.size))
        phase = generator.uniform(-np.pi, np.pi, self.latent)
        return Made((dense(weight, phase, "sin"),))
