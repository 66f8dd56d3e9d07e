"""What an encoder is: scaled observations to latents, and the file that holds it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from jbrep.errors import InputError

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Encoder:
    """An encoder of one layer with its decoder, as the denoising autoencoder leaves it.

    It takes observations that are scaled by the task's nominal ranges and scales them again, to
    [-1, 1] over its training data.
    """

    header: dict[str, Any]  # task, feature_names, training settings, metrics
    low: Float32  # (d,) over the training data
    high: Float32  # (d,)
    encoder_weight: Float32  # (l, d)
    encoder_bias: Float32  # (l,)
    decoder_weight: Float32  # (d, l)
    decoder_bias: Float32  # (d,)

    def __post_init__(self) -> None:
        latent, size = self.encoder_weight.shape
        expected = {
            "low": (size,),
            "high": (size,),
            "encoder_bias": (latent,),
            "decoder_weight": (size, latent),
            "decoder_bias": (size,),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise InputError(
                    f"tensor {name} has shape {getattr(self, name).shape}: {shape} is needed"
                )

    @property
    def latent_size(self) -> int:
        """Length l of a latent."""
        return len(self.encoder_weight)

    def __call__(self, observation: Float32) -> Float32:
        """Scaled observations (n, d) to latents (n, l) in [-1, 1]."""
        unit = 2 * (observation - self.low) / (self.high - self.low) - 1
        return np.tanh(unit @ self.encoder_weight.T + self.encoder_bias)

    def decode(self, latent: Float32) -> Float32:
        """Latents (n, l) to reconstructed scaled observations (n, d)."""
        unit = np.tanh(latent @ self.decoder_weight.T + self.decoder_bias)
        return (unit + 1) / 2 * (self.high - self.low) + self.low

    def check_task(self, task: str, feature_names: tuple[str, ...]) -> None:
        """Make sure that the encoder reads this task's observations.

        Raises:
            InputError: it was trained on other features.
        """
        if self.header["feature_names"] != list(feature_names):
            raise InputError(
                f"the encoder was trained on {self.header['task']}, whose features differ from "
                f"those of {task}: train one on {task}"
            )

    def save(self, path: Path) -> None:
        """Write a safetensors file with a JSON header."""
        path.parent.mkdir(parents=True, exist_ok=True)
        tensors = {name: np.ascontiguousarray(getattr(self, name)) for name in _TENSORS}
        save_file(tensors, path, {"jbrep": json.dumps(self.header)})

    @classmethod
    def load(cls, path: Path) -> "Encoder":
        """Read an encoder file; nothing in it is run.

        Raises:
            InputError: no such file, another kind of file, or a tensor missing or misshapen.
        """
        try:
            with safe_open(path, framework="np") as file:
                header = json.loads((file.metadata() or {})["jbrep"])
                return cls(header, *(file.get_tensor(name) for name in _TENSORS))
        except FileNotFoundError:
            raise InputError(f"no encoder at {path}") from None
        except (SafetensorError, KeyError, ValueError) as error:
            raise InputError(f"{path} is not a jbrep encoder: {error}") from None


_TENSORS = (
    "low",
    "high",
    "encoder_weight",
    "encoder_bias",
    "decoder_weight",
    "decoder_bias",
)
