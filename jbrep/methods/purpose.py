"""Whether an encoder is good at what its kind is for, in words."""

from jbrep.dataset import ScaledDataset
from jbrep.encoders import Encoder
from jbrep.encoders.header import HELD_OUT_MSE
from jbrep.methods.held_out import ratio_to_pca
from jbrep.methods.linear import PCA
from jbrep.methods.registry import METHODS
from jbrep.training.method import Reconstructing

_ALIKE = 0.05  # of PCA's error, within which another is as good
_POOR = 1.5  # times PCA's error, from which a trained autoencoder deserves a warning


def purpose(encoder: Encoder, data: ScaledDataset) -> str:
    """How good an encoder is at what its kind is for; empty of one that is for nothing of its own.

    Args:
        encoder: made of these data by a method.
        data: to reconstruct, where that is what it is for.
    """
    method = METHODS[encoder.kind]
    if not issubclass(method, Reconstructing | PCA):
        return method.achieved(encoder.header.metrics, encoder.latent_size - len(encoder.kept))
    error = f"{encoder.header.metrics[HELD_OUT_MSE]:.5f}, of features scaled to [-1, 1]"
    ratio = ratio_to_pca(encoder, data)
    if method is PCA or ratio is None:
        return f"reconstructs held-out states with a mean squared error of {error}"
    told = (
        f"reconstructs held-out states {_beside(ratio)} PCA: {ratio:.2f} times its error ({error})"
    )
    if ratio <= _POOR:
        return told
    return (
        f"{told}; train for more --epochs, on more data, or with another --learning-rate or "
        "--batch-size"
    )


def _beside(ratio: float) -> str:
    if abs(ratio - 1) < _ALIKE:
        return "as well as"
    return "better than" if ratio < 1 else "worse than"
