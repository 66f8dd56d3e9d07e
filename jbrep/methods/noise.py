"""The scaled observation, padded with units that say nothing."""

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.linear import dense
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.settings import REQUIRED

_FREQUENCY = 1000  # [rad] that a phase turns while a scaled feature goes from 0 to 1


def make(data: ScaledDataset, settings: Settings) -> Made:
    """All features pass around the layers; each unit beside them is the sine of a fast phase.

    An encoder draws nothing, so that the noise is of the observation itself: sin(W x + b), with
    W of N(0, 1000^2) and b uniform. From one step to the next, phases turn many times over, so that
    neighbouring values are unrelated. In float32 they are known to about 0.001 only, by which
    libraries may differ.
    """
    generator = np.random.default_rng(settings["seed"])
    shape = settings["latent"] - data.size, data.size
    weight = _FREQUENCY * generator.normal(size=shape)
    phase = generator.uniform(-np.pi, np.pi, size=len(weight))
    nothing = dense(np.zeros(shape[::-1]), np.zeros(data.size))
    return Made((dense(weight, phase, "sin"),), (nothing,), keep=data.task.feature_names)


def _check(data: ScaledDataset, settings: Settings) -> None:
    if settings["keep"]:
        raise InputError("noise keeps all features as they are: leave keep out")
    if settings["latent"] <= data.size:
        raise InputError(
            f"latent size is {settings['latent']}: with {data.size} features and noise beside them "
            f"it must be at least {data.size + 1}"
        )


METHOD = ClosedForm(
    name="noise",
    words="the scaled observation, padded to l units with noise",
    own={"latent": REQUIRED, "seed": 0},
    check=_check,
    reduces=False,
    make=make,
)
