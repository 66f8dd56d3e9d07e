"""An encoder of one's own: a torch module, trained without jbrep."""

import torch
from torch import nn


class Net(nn.Module):
    """Scales an observation, and passes it through one hidden layer to the latent."""

    def __init__(self, size: int, latent: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("deviation", torch.ones(size))
        self.layers = nn.Sequential(nn.Linear(size, 32), nn.SiLU(), nn.Linear(32, latent))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Latents (n, l) of observations (n, d)."""
        return self.layers((observation - self.mean) / self.deviation)


def trained() -> Net:
    """The module with the weights in net.pt, which jbrep calls as net:trained."""
    weights = torch.load("net.pt", weights_only=True)
    net = Net(len(weights["mean"]), len(weights["layers.2.bias"]))
    net.load_state_dict(weights)
    return net
