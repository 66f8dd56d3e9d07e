"""Variational autoencoders (Kingma and Welling 2014): with a sigmoid decoder, and the LLD-VAE.

The authors' had a layer of d/16 = 1 unit before its 15 latents, which left one number of the state,
and gave agents sampled codes. Here hidden layers are wider than the code, which is the mean; and
the divergence weighs less, for cross-entropy hardly sees features of small spread.
"""

import math
from abc import abstractmethod
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from jbrep.dataset import ScaledDataset
from jbrep.encoders.layers import Layer
from jbrep.training import settings
from jbrep.training.method import Network, Reconstructing
from jbrep.training.network import get_architecture, layers, seeded, stack
from jbrep.training.objective import Layers, Objective, feature_weights
from jbrep.training.windows import Windows

_LEAST, _MOST = -7.0, 7.0  # log standard deviation of a posterior
_RECONSTRUCTED = math.log(0.01), math.log(10)  # the same of a reconstruction
_SINGULAR = 1e-6  # least |1 + v' r|

Beta = Annotated[settings.Weight, Meta(description="Weight of the divergence from the prior.")]


class Variational(Network, Reconstructing, frozen=True, kw_only=True):
    """A method whose code has a distribution."""

    architecture: settings.Architecture = "deep"
    beta: Beta = 0.001
    batch_size: settings.BatchSize = 256
    learning_rate: settings.LearningRate = 1e-3


class Vae(Variational, frozen=True, kw_only=True):
    """Variational autoencoder with a sigmoid decoder; the latent is the mean.

    Kingma and Welling 2014; Higgins et al. 2017.
    """

    name: ClassVar[str] = "vae"

    epochs: settings.Epochs = 5

    def objective(self, data: ScaledDataset) -> Objective:
        return VaeObjective(self, data)


def posterior(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log standard deviation, (n, l) each, in an encoder's output (n, 2 l)."""
    mean, log_deviation = values.chunk(2, 1)
    return mean, log_deviation.clamp(_LEAST, _MOST)


def divergence(mean: Tensor, log_deviation: Tensor) -> Tensor:
    """KL of N(mean, deviation^2) from N(0, 1), of each unit, (n, l)."""
    return (mean.square() + (2 * log_deviation).exp() - 1) / 2 - log_deviation


def first_half(layers: Layers) -> Layers:
    """Layers of which the last gives only the first half of its units."""
    weight, bias, activation = layers[-1]
    count = len(bias) // 2
    return (*layers[:-1], Layer(weight[:count].copy(), bias[:count].copy(), activation))


class VariationalObjective(Objective):
    """A code with a distribution: drawn from in training, its mean in evaluation and in the file.

    Batches end with the noise of the codes, (n, l), 0 in evaluation.
    """

    _weights: Tensor | None

    def __init__(self, method: Variational, data: ScaledDataset):
        super().__init__()
        self._latent, self._beta = method.latent, method.beta
        self._hidden = get_architecture(method.architecture).hidden
        with seeded(method.seed):
            self.encoder = stack((data.size, *self._hidden, 2 * self._latent), "linear")
            self.build(data)
        weights = feature_weights(data, method.weights)
        self.register_buffer("_weights", weights, persistent=False)

    @abstractmethod
    def build(self, data: ScaledDataset) -> None:
        """Make the decoder, and what else there is, from torch's generator."""

    def inputs(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        """What a batch has before its noise; rows first."""
        return (windows.rows(numbers),)

    def batch(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        inputs = self.inputs(windows, numbers)
        return *inputs, inputs[0].new_zeros(1, self._latent).expand(len(inputs[0]), -1)

    def draws(
        self, windows: Windows, numbers: Tensor, size: int, generator: torch.Generator
    ) -> Iterator[tuple[Tensor, ...]]:
        *inputs, zeros = self.batch(windows, numbers)
        noise = torch.empty(zeros.shape, device=zeros.device).normal_(generator=generator)
        yield from zip(*(part.split(size) for part in (*inputs, noise)), strict=True)

    def report(self, windows: Windows) -> dict[str, Any]:
        """The mean divergence of each unit [nat]: about 0 for one that says nothing."""
        rows = self.inputs(windows, windows.numbers)[0]
        return {"divergence": divergence(*posterior(self.encoder(rows))).mean(0).tolist()}


class VaeObjective(VariationalObjective):
    """The cross-entropy of a row, summed over its numbers, and `beta` times the divergence."""

    def build(self, data: ScaledDataset) -> None:
        self.decoder = stack((self._latent, *reversed(self._hidden), data.size), "linear")

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        rows, noise = batch
        mean, log_deviation = posterior(self.encoder(rows))
        logits = self.decoder(mean + log_deviation.exp() * noise)
        error = cross_entropy(logits, rows, self._weights).sum(1)
        return (error + self._beta * divergence(mean, log_deviation).sum(1)).mean()

    def layers(self) -> tuple[Layers, Layers]:
        return first_half(layers(self.encoder)), sigmoid_layers(layers(self.decoder))


def cross_entropy(logits: Tensor, rows: Tensor, weights: Tensor | None) -> Tensor:
    """The binary cross-entropy of each number, (n, d).

    Scaled values beyond [-1, 1], which held-out rows and scalings other than by extrema have, count
    as its ends: no sigmoid gives more, and beyond them the cross-entropy has no least value.
    """
    target = ((rows + 1) / 2).clamp(0, 1)
    return binary_cross_entropy_with_logits(logits, target, weights, reduction="none")


def sigmoid_layers(layers: Layers) -> Layers:
    """Layers that give logits, followed by what makes them scaled numbers, 2 sigmoid - 1."""
    weight, bias, _ = layers[-1]
    size = len(bias)
    back = Layer(2 * np.eye(size, dtype=np.float32), -np.ones(size, np.float32), "linear")
    return (*layers[:-1], Layer(weight, bias, "sigmoid"), back)


class LldVae(Variational, frozen=True, kw_only=True):
    """The authors' LLD-VAE (E2C): a variational latent that moves linearly with the action.

    "Embed to Control", Watter et al. 2015. Here deviations of both likelihoods are bounded, for
    else that of a feature that is constant or a function of others has no greatest value; pairs
    are of one episode, with the action between them.
    """

    name: ClassVar[str] = "lld-vae"

    beta: Beta = 1.0
    transition: settings.TransitionWeight = 0.1
    batch_size: settings.BatchSize = 1000

    def objective(self, data: ScaledDataset) -> Objective:
        return LldVaeObjective(self, data)


class LldVaeObjective(VariationalObjective):
    """The likelihoods of a row and the next one, with the divergences of the code and its move.

    The transition network gives v, r, B and o of the step z' = A z + B u + o with A = I + v r'. To
    the negative log-likelihoods come `beta` times the divergence of the code from N(0, 1) and
    `transition` times that of the moved code from the next row's.
    """

    def __init__(self, method: LldVae, data: ScaledDataset):
        super().__init__(method, data)
        self._transition_weight = method.transition

    def build(self, data: ScaledDataset) -> None:
        count = self._latent
        self.decoder = stack((count, *reversed(self._hidden), 2 * data.size), "linear")
        self.transition = stack((count, count, count * (3 + data.task.action_size)), "linear")

    def inputs(self, windows: Windows, numbers: Tensor) -> tuple[Tensor, ...]:
        return windows.steps(numbers)

    def step(self, code: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """How codes near these move: v and r of A = I + v r', and B u + o; (n, l) each."""
        count = self._latent
        moves = self.transition(code)
        left, right, offset = moves[:, : 3 * count].chunk(3, 1)
        driven = moves[:, 3 * count :].view(len(code), count, -1) @ action[:, :, None]
        return left, right, driven[:, :, 0] + offset

    def loss(self, batch: tuple[Tensor, ...]) -> Tensor:
        now, action, after, noise = batch
        mean, log_deviation = posterior(self.encoder(now))
        code = mean + log_deviation.exp() * noise
        left, right, shift = self.step(code, action)
        error = self._negative_log_likelihood(code, now)
        error += self._negative_log_likelihood(moved(code, left, right) + shift, after)
        ahead = transition_divergence(
            moved(mean, left, right) + shift,
            log_deviation,
            left,
            right,
            *posterior(self.encoder(after)),
        )
        prior = divergence(mean, log_deviation).sum(1)
        return (error + self._beta * prior + self._transition_weight * ahead).mean()

    def _negative_log_likelihood(self, code: Tensor, rows: Tensor) -> Tensor:
        mean, log_deviation = self.decoder(code).chunk(2, 1)
        log_deviation = log_deviation.clamp(*_RECONSTRUCTED)
        squares = ((rows - mean) / log_deviation.exp()).square() / 2
        each = squares + log_deviation + math.log(2 * math.pi) / 2
        return (each if self._weights is None else each * self._weights).sum(1)

    def layers(self) -> tuple[Layers, Layers]:
        return first_half(layers(self.encoder)), first_half(layers(self.decoder))


def moved(code: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """(I + v r') z, of codes and vectors (n, l)."""
    return code + left * (right * code).sum(1, keepdim=True)


def transition_divergence(
    mean: Tensor,
    log_deviation: Tensor,
    left: Tensor,
    right: Tensor,
    next_mean: Tensor,
    next_log_deviation: Tensor,
) -> Tensor:
    """KL of N(m, A S A') from N(n, T), with A = I + v r', and S and T diagonal, (n,).

    By det A = 1 + v' r nothing of size (l, l) is made (Watter et al. 2015, appendix). All are
    (n, l): m, half the logarithm of S, v and r, n, half the logarithm of T.
    """
    variance, precision = (2 * log_deviation).exp(), (-2 * next_log_deviation).exp()
    spread = (right.square() * variance).sum(1, keepdim=True)
    diagonal = variance * (1 + 2 * left * right) + left.square() * spread  # of A S A'
    distance = (next_mean - mean).square()
    determinant = (1 + (left * right).sum(1)).abs().clamp_min(_SINGULAR)
    each = (precision * (diagonal + distance) - 1) / 2 + next_log_deviation - log_deviation
    return each.sum(1) - determinant.log()
