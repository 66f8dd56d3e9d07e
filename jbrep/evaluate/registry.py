"""What a diagnostic is: a function of a judged encoder, registered with the columns it fills.

evaluation.json, diagnostics.csv, the tables on the screen and a study's report follow from what is
registered, so that a further diagnostic is a further function, such as

    @diagnostic(Scalar("farthest", "the largest mean of a unit", better=-1))
    def farthest(e: Judged) -> Score:
        return Score(max(map(abs, e.known.latent_units.mean)))
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from jbrep.encoders.base import BaseEncoder
from jbrep.evaluate.evaluation import Diagnostics, Score, Scores

if TYPE_CHECKING:
    from jbrep.evaluate.control import GoodPolicy
    from jbrep.evaluate.held_out import HeldOut
    from jbrep.evaluate.regression import Networks


class Judged(NamedTuple):
    """An encoder on held-out episodes, with what all diagnostics of it share."""

    encoder: BaseEncoder
    held_out: "HeldOut"
    policy: "GoodPolicy | None"  # that does the task well, if one is known
    learnt: "Networks"  # regressions from the latent
    known: Diagnostics  # prediction, probes, reconstruction and units; no scores yet


class Scalar(NamedTuple):
    """A named number of an encoder's diagnostics: a column of diagnostics.csv."""

    name: str
    words: str  # what it is, in a few words
    better: int = 1  # 1 if higher is better, -1 if lower is
    is_first: bool = False  # whether it is among the first that a user sees

    def read(self, known: Diagnostics) -> Score | None:
        """Its score, if an evaluation has it."""
        return known.scores.get(self.name)


SCALARS: dict[str, Scalar] = {}  # by name; complete where jbrep.evaluate.diagnosis is imported
_REGISTERED: list[tuple[Callable[[Judged], Any], tuple[str, ...]]] = []
_Measure = TypeVar("_Measure", bound=Callable[[Judged], Any])


def diagnostic(*scalars: Scalar) -> Callable[[_Measure], _Measure]:
    """Register a function that returns the score of a scalar; of several, a tuple of theirs.

    A score is None where it isn't known.
    """

    def register(measure: _Measure) -> _Measure:
        SCALARS.update({each.name: each for each in scalars})
        _REGISTERED.append((measure, tuple(each.name for each in scalars)))
        return measure

    return register


def measured(judged: Judged) -> Scores:
    """The scores of an encoder, as far as they are known, in the order of registration."""
    scores: Scores = {}
    for measure, names in _REGISTERED:
        found = measure(judged)
        several = (found,) if len(names) == 1 else found
        scores |= {name: s for name, s in zip(names, several, strict=True) if s is not None}
    return scores
