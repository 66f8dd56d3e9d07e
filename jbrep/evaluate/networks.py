"""The networks that diagnostics of an encoder need."""

from functools import lru_cache
from itertools import chain
from typing import NamedTuple

from jbrep.encoders.base import BaseEncoder
from jbrep.evaluate import policy, prediction, readout
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.policy import GoodPolicy
from jbrep.evaluate.regression import Predictor, beside, fit


class Networks(NamedTuple):
    """What was learnt from the latents of an encoder.

    Attributes:
        forward: what comes next, by the number of steps ahead.
        probe: the state.
        of_policy: a good policy's `action` and, unless its episodes are too few, its `value`;
            nothing without one.
    """

    forward: dict[int, Predictor]
    probe: Predictor
    of_policy: dict[str, Predictor]


@lru_cache(64)  # diagnostics of an encoder share them
def networks(encoder: BaseEncoder, held_out: HeldOut, good: GoodPolicy | None = None) -> Networks:
    """All of them, fitted at once: one after the other they would take nearly twice as long."""
    ahead = prediction.problems(encoder, held_out)
    of_policy = policy.problems(encoder, held_out, good) if good else {}
    pairs = chain.from_iterable(ahead.values())
    fitted = iter(fit([*pairs, readout.problem(encoder, held_out), *of_policy.values()]))
    forward = {k: beside(next(fitted), next(fitted)) for k in ahead}
    return Networks(forward, next(fitted), dict(zip(of_policy, fitted, strict=True)))
