"""Random Fourier features: a code larger than the observation that learns nothing."""

from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import dense
from jbrep.training.method import ClosedForm, Coded, Made
from jbrep.training.settings import Seed


class Fourier(Coded, ClosedForm, frozen=True, kw_only=True):
    """Sines of random directions, in which functions of the observation are nearly linear."""

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
