"""A random projection."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.methods.linear import linear_code
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """Uniformly random orthonormal directions."""
    drawn = np.random.default_rng(settings["seed"]).normal(size=(data.size, settings["latent"]))
    directions, triangle = np.linalg.qr(drawn)
    return Made(*linear_code((directions * np.sign(np.diag(triangle))).T, data.moments))


METHOD = ClosedForm(
    name="random",
    words="l random orthonormal directions",
    own={"latent": REQUIRED, "seed": 0},
    make=make,
)
