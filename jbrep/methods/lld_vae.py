"""The authors' LLD-VAE: codes that move linearly, from each state on its own, with the action.

It is "Embed to Control" (E2C, Watter et al. 2015). Here both deviations are bounded, for else the
likelihood of a feature that is constant or a function of others has no greatest value; pairs are of
one episode, with the action between them.
"""

import math
from typing import ClassVar

from torch import Tensor

from jbrep.dataset import ScaledDataset
from jbrep.methods.vae import (
    Beta,
    Variational,
    VariationalObjective,
    divergence,
    first_half,
    posterior,
)
from jbrep.training.network import layers, stack
from jbrep.training.objective import Layers, Objective
from jbrep.training.settings import BatchSize, TransitionWeight
from jbrep.training.windows import Windows

_LEAST, _MOST = math.log(0.01), math.log(10)  # log standard deviation of a reconstruction
_SINGULAR = 1e-6  # least |1 + v' r|


class LldVae(Variational, frozen=True, kw_only=True):
    """The authors' LLD-VAE (E2C): a variational code that moves linearly with the action."""

    name: ClassVar[str] = "lld-vae"

    beta: Beta = 1.0
    transition: TransitionWeight = 0.1
    batch_size: BatchSize = 1000

    def objective(self, data: ScaledDataset) -> Objective:
        return LldVaeObjective(self, data)


class LldVaeObjective(VariationalObjective):
    """The likelihoods of a row and the next one, with the divergences of the code and its move.

    The transition network gives v, r, B and o of the step z' = A z + B u + o with A = I + v r'. To
    the negative log-likelihoods come `beta` times the divergence of the code from N(0, 1) and
    `transition` times that of the moved code from the next row's.
    """

    horizon = 1

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
        log_deviation = log_deviation.clamp(_LEAST, _MOST)
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
