"""An autoencoder's network as it was initialised."""

from jbrep.dae.network import get_architecture, layers, stacks
from jbrep.dataset import ScaledDataset
from jbrep.methods.autoencoder import check
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The network that training would begin with."""
    architecture = get_architecture(settings["architecture"])
    encoder, decoder = stacks(architecture, data.size, settings["latent"], settings["seed"])
    return Made(layers(encoder), layers(decoder))


METHOD = ClosedForm(
    name="untrained",
    words="the autoencoder's network as it was initialised",
    own={"latent": REQUIRED, "architecture": "paper", "seed": 0},
    check=check,
    make=make,
)
