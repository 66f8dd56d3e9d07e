"""What is known of encoders from held-out episodes: evaluation.json, and the diagnostics in it.

A diagnostic is a function of a judged encoder, registered with the columns that it fills.
evaluation.json, diagnostics.csv, the tables on the screen and a study's report follow from what is
registered, so that a further diagnostic is a further function, such as

    @diagnostic(Scalar("farthest", "the largest mean of a unit", better=-1))
    def farthest(e: Judged) -> Score:
        return Score(max(map(abs, e.known.latent_units.mean)))
"""

import json
from collections.abc import Callable, Iterable
from math import isfinite
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, TypeVar

from msgspec import UNSET, UnsetType

from jbrep.records.document import Document
from jbrep.records.record import Record
from jbrep.stats.bootstrap import Interval

if TYPE_CHECKING:
    from jbrep.encoders.base import BaseEncoder
    from jbrep.evaluation.control import GoodPolicy
    from jbrep.evaluation.held_out import HeldOut
    from jbrep.evaluation.regression import Networks

EVALUATION = "evaluation.json"
KEPT = "kept_features"  # in what a method says: how many pass around its layers
_DIGITS = 6
_USUAL = 10  # steps ahead


def nearest_horizon(horizons: Iterable[int]) -> int | None:
    """Of numbers of steps ahead the one that counts first: the nearest to 10; None of none."""
    return min(horizons, key=lambda steps: abs(steps - _USUAL), default=None)


class Score(NamedTuple):
    """A value with its 95 % bootstrap interval over episodes; None where it isn't defined."""

    value: float | None
    low: float | None = None
    high: float | None = None


Scores = dict[str, Score]  # by name


def score(interval: Interval) -> Score:
    """The score that a bootstrap of one number gives."""
    return Score(*interval.tolist())


def scores(interval: Interval) -> list[Score]:
    """The scores that a bootstrap of n numbers gives."""
    return [Score(*values) for values in interval.tolist()]


class FeatureError(Record, frozen=True, kw_only=True):
    """What the reconstruction loses of a feature."""

    name: str
    unit: str
    mse: Score  # scaled to [-1, 1]
    rmse_physical: Score  # in its unit
    r2: Score


class Reconstruction(Record, frozen=True, kw_only=True):
    """Squared errors over all held-out rows, of features scaled to [-1, 1]."""

    mse: Score
    pca_mse: Score  # of PCA with as many components, fitted on the training part
    ratio_to_pca: Score | None  # None of a latent as large as the state, or if PCA loses nothing
    features: tuple[FeatureError, ...]


class LatentUnits(Record, frozen=True, kw_only=True):
    """The l units of a latent."""

    mean: tuple[float, ...]
    variance: tuple[float, ...]
    dead: tuple[int, ...]  # numbers of units that hardly vary
    participation_ratio: float | None  # None where all are dead


class Prediction(Record, frozen=True, kw_only=True):
    """R^2 of what comes so many steps later, from the latent and the actions until then."""

    features: Scores  # of each feature's change
    reward: Score  # of the mean reward on the way
    mean: Score  # over the features that change
    rewarded: Score | None  # the same, weighted by how much the reward depends on each


class Lost(Record, frozen=True, kw_only=True):
    """A feature that a controller needs and that can't be read from the latent."""

    name: str
    kept: float  # R^2
    need: float  # 0 to 1


class Diagnostics(Record, frozen=True, kw_only=True):
    """All that is known of an encoder; docs/diagnostics.md describes each part."""

    kind: str
    latent: int
    sha256: str | None = None  # of the encoder; None of the full observation
    scores: Scores  # the registered diagnostics, as far as they are known
    prediction: dict[str, Prediction]  # by the number of steps ahead
    loses: tuple[Lost, ...]  # the most needed first
    nonlinear_probes: Scores  # R^2 of each feature
    reconstruction: Reconstruction | None  # None of an encoder that doesn't decode
    latent_units: LatentUnits
    method: dict[str, Any]  # what the method says of its own fit, with KEPT

    @property
    def horizon(self) -> int | None:
        """The steps ahead that count first; None where episodes are too short to look ahead."""
        return nearest_horizon(map(int, self.prediction))

    def ahead(self, what: str) -> Score | None:
        """A score of the prediction at that horizon, if it is known."""
        return getattr(self.prediction[str(self.horizon)], what) if self.prediction else None


class JudgedOn(Record, frozen=True, kw_only=True):
    """The data set that encoders were judged on, and its parts."""

    task: str
    fingerprint: str
    policy: dict[str, Any]
    seed: int | None
    train_rows: int
    test_rows: int
    test_episodes: int
    constant_features: tuple[str, ...]
    truth: str | UnsetType = UNSET  # fingerprint of the data set with what these hide
    hidden: tuple[str, ...] | UnsetType = UNSET  # features, which are among the probes


class Evaluation(Document, frozen=True, kw_only=True):
    """Encoders side by side, the full observation first."""

    format: ClassVar[str] = "jbrep evaluation"
    format_version: ClassVar[int] = 5
    indent: ClassVar[int] = 1

    data: JudgedOn
    resamples: int  # of the bootstrap
    seen: dict[str, Literal["no test row", "none", "maybe"]]  # of these rows in training, by label
    policy: str | None  # the name of the good policy
    needs: dict[str, float]  # how much a controller needs each feature, 0 to 1
    encoders: dict[str, Diagnostics]  # by label

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the encoders, by label."""
        return {name: each.sha256 for name, each in self.encoders.items() if each.sha256}

    def text(self) -> str:
        """As JSON, with numbers of six digits."""
        return json.dumps(_rounded(self.as_json()), indent=self.indent) + "\n"


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {name: _rounded(each) for name, each in value.items()}
    return [_rounded(each) for each in value] if isinstance(value, list | tuple) else value


class Judged(NamedTuple):
    """An encoder on held-out episodes, with what all diagnostics of it share."""

    encoder: "BaseEncoder"
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


SCALARS: dict[str, Scalar] = {}  # by name; complete where jbrep.evaluation.diagnosis is
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
        for name, score in zip(names, several, strict=True):
            if score is not None:  # JSON has no NaN
                scores[name] = Score(*(v if v is not None and isfinite(v) else None for v in score))
    return scores
