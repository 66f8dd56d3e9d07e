"""Encoders with and without the jump of an angle, for `face_direction`, as a study takes them.

    jbrep study studies/jump-face-direction.toml --import jump --out runs/jump

with examples/jump on the PYTHONPATH. An angle to a target jumps where the target is behind.
"""

import math

import torch

from jbrep.encoders import find
from jbrep.envs import describe

_TASK = describe("face_direction")
_ANGLE = _TASK.feature_names.index("angle_to_target")


class WithJump(torch.nn.Module):
    """Coordinates, which have no jump, and the angle to the target, which has one."""

    def __init__(self) -> None:
        super().__init__()
        self.coordinates = find("coordinates", _TASK)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Codes (n, l) of observations (n, d)."""
        angle = observation[..., [_ANGLE]]
        return torch.cat((self.coordinates.encode(observation), angle / math.pi), -1)


class WithoutJump(torch.nn.Module):
    """The observation, with cosine and sine in place of the angle to the target."""

    def __init__(self) -> None:
        super().__init__()
        self.full = find("full", _TASK)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Codes (n, l) of observations (n, d)."""
        angle = observation[..., [_ANGLE]]
        others = [i for i in range(_TASK.size) if i != _ANGLE]
        return torch.cat((self.full.encode(observation)[..., others], angle.cos(), angle.sin()), -1)
