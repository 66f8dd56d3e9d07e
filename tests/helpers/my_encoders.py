"""A module of a user's own encoders, for observations of the Jitterbug's face_direction."""

import numpy as np
import torch

SIZE, LATENT = 16, 3


class Net(torch.nn.Module):
    """No chain of layers: it skips one."""

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(7)
            self.hidden = torch.nn.Linear(SIZE, SIZE)
            self.out = torch.nn.Linear(SIZE, LATENT)

    def forward(self, observation):
        return self.out(observation + torch.tanh(self.hidden(observation)))


def dense():
    """A chain of layers."""
    with torch.random.fork_rng():
        torch.manual_seed(8)
        layers = torch.nn.Linear(SIZE, 6), torch.nn.Tanh(), torch.nn.Linear(6, LATENT)
    return torch.nn.Sequential(*layers)


class Unseeded(torch.nn.Linear):
    """Another one each time."""

    def __init__(self):
        super().__init__(SIZE, LATENT)


class FirstFeatures:
    """An object with `encode`, as a user has it in Python alone."""

    def __init__(self, sign=1):
        self.sign = sign

    def encode(self, observations):
        return self.sign * np.asarray(observations)[:, :LATENT]
