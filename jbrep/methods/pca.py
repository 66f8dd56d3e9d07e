"""Principal components."""

from jbrep.dataset import ScaledDataset
from jbrep.methods.linear import principal_code
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The first principal components."""
    return Made(*principal_code(data, settings["latent"]))


METHOD = ClosedForm(
    name="pca",
    words="the first l principal components: of all linear codes, the least error",
    own={"latent": REQUIRED},
    make=make,
)
