"""Autoencoders, plain and denoising."""

from typing import Any

import torch
from torch import Tensor

from jbrep.dae.network import check_size, get_architecture
from jbrep.dae.objective import Reconstruction
from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.method import Learned, Settings
from jbrep.methods.settings import REQUIRED

NOISE = 0.1  # standard deviation, of features scaled to [-1, 1]


def check(data: ScaledDataset, settings: Settings) -> None:
    """Make sure that the network and the weights fit the data.

    Raises:
        InputError: they don't.
    """
    check_size(settings["architecture"], data.size, settings["latent"])
    feature_weights(data, settings.get("weights", {}))


def feature_weights(data: ScaledDataset, weights: Settings) -> Tensor | None:
    """A weight for each number of a scaled row, (size,); None where all are 1.

    Raises:
        InputError: a weight of an unknown feature or one that isn't encoded, or none above 0.
    """
    if unknown := [name for name in weights if name not in data.names]:
        if unknown[0] in data.task.feature_names:
            raise InputError(
                f"{unknown[0]} passes around the encoder unchanged: it can't have a weight"
            )
        known = ", ".join(dict.fromkeys(data.names))  # angles come twice
        raise InputError(f"a weight of {unknown[0]!r}, which is no feature: there are {known}")
    values = torch.tensor([float(weights.get(name, 1)) for name in data.names])
    if not values.any():
        raise InputError("all weights of features are 0: give at least one above 0")
    return values if weights else None


def objective(data: ScaledDataset, settings: Settings) -> Reconstruction:
    """The network with its loss."""
    names = ("latent", "seed", "initial", "noise", "shared_noise")
    return Reconstruction(
        get_architecture(settings["architecture"]),
        data.size,
        weights=feature_weights(data, settings["weights"]),
        **{name: settings[name] for name in names if name in settings},
    )


def _check_denoising(data: ScaledDataset, settings: Settings) -> None:
    check(data, settings)
    if not settings["noise"]:
        raise InputError("dae without noise is a plain autoencoder: use the kind ae")


class _Autoencoder(Learned):
    """Architectures have their own epochs and learning rate."""

    def fill(self, given: Settings) -> dict[str, Any]:
        """As for `Method`."""
        defaults = self.defaults
        used = get_architecture(given.get("architecture", defaults["architecture"]))
        return {**defaults, "epochs": used.epochs, "learning_rate": used.learning_rate}


_OWN = {
    "latent": REQUIRED,
    "architecture": "paper",
    "epochs": None,
    "batch_size": None,
    "learning_rate": None,
    "seed": 0,
    "initial": "torch",
    "weights": {},
}
AE = _Autoencoder(
    name="ae", words="autoencoder without noise", own=_OWN, check=check, objective=objective
)
DAE = _Autoencoder(
    name="dae",
    words="denoising autoencoder: noise on each feature of each row, the clean row as target",
    own={**_OWN, "noise": NOISE, "shared_noise": False},
    presets={"authors": {"initial": "normal", "shared_noise": True}},
    check=_check_denoising,
    objective=objective,
)
