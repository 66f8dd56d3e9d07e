"""Which codes serve a controller as the full observation does, in a sentence."""

from collections.abc import Mapping
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Evaluation, Lost
from jbrep.report.words import enumerated
from jbrep.text import counted, r2_text

_MEASURES = {  # the first that the full observation tells anything of counts
    "rewarded": "the change of what the reward depends on",
    "reward": "the reward",
    "mean": "what the features change by",
}
_TOLD = 0.1  # R² of it from the full observation, at least
_AS_GOOD = 0.9  # the share of that from which a code serves as well


class _Measured(NamedTuple):
    """How well each code, and the full observation, tell what comes next."""

    what: str  # over the next so many steps
    r2: Mapping[str, float]  # of codes, the best first
    full: float

    @property
    def good(self) -> list[str]:
        """The codes that tell about as much as the best of all, the full observation among them."""
        least = _AS_GOOD * max((self.full, *self.r2.values()))
        return [label for label, r2 in self.r2.items() if r2 >= least]


def good_codes(evaluation: Evaluation) -> list[str]:
    """The codes that should serve a controller, the best first."""
    measured = _measured(evaluation)
    return measured.good if measured else []


def falling_short(evaluation: Evaluation) -> list[str]:
    """The codes that are known to tell less than a controller's should."""
    measured = _measured(evaluation)
    return [label for label in measured.r2 if label not in measured.good] if measured else []


def serving(evaluation: Evaluation) -> str:
    """Which codes serve, or which comes nearest, or why that can't be said."""
    measured = _measured(evaluation)
    if measured is None:
        unsaid = "Which code serves can't be said"
        if evaluation.encoders[FULL].horizon is None:
            return f"{unsaid}: {untold(evaluation)}."
        return (
            f"{unsaid}: in these {evaluation.data.test_rows:,} held-out "
            "steps even the full observation tells next to nothing of what comes next. Judge them "
            "on more data."
        )
    if not measured.r2:
        return f"The full observation alone: R² {r2_text(measured.full)} of {measured.what}."
    take = recommended(evaluation)
    if take is None:
        return f"No code should serve as the full observation does{_nearest(evaluation, measured)}"
    return f"Take {take}: it tells {_told(measured, measured.r2[take])}{_beside(evaluation, take)}"


def _nearest(evaluation: Evaluation, measured: _Measured) -> str:
    """The end of the sentence where no code serves: which comes nearest, if one does."""
    telling = {label: r2 for label, r2 in measured.r2.items() if r2 >= _TOLD}
    if not telling:
        most = max(0.0, *measured.r2.values())
        return f": none tells {_told(measured, most, 'more than an R²')}."
    lacks = lacking(evaluation)
    nearest = min(telling, key=lambda label: bool(lacks[label]))  # else the best of them
    return f". {nearest} comes nearest: it tells {_told(measured, telling[nearest])}."


def recommended(evaluation: Evaluation) -> str | None:
    """The smallest of the codes that should serve, if possible one that lacks nothing."""
    good, lacks = good_codes(evaluation), lacking(evaluation)
    whole = [label for label in good if not lacks[label]]
    size = {label: evaluation.encoders[label].latent for label in good}
    return min(whole or good, key=size.__getitem__, default=None)


def _beside(evaluation: Evaluation, take: str) -> str:
    """The end of the sentence on the code to take: of which it is the smallest, what lacks what."""
    good, lacks = good_codes(evaluation), lacking(evaluation)
    lost = [label for label in good if lacks[label]]
    if take in lost:
        if len(good) == 1:
            return ". But see what it lacks."
        return f", and is the smallest that does, of {enumerated(good)}. But see what each lacks."
    whole = [label for label in good if label not in lost]
    known = "" if untold(evaluation) else " and lacks nothing"
    said = f", and is the smallest that does{known}, of {enumerated(whole)}"
    end = f"{said if len(whole) > 1 else ''}."
    if lost:
        tells, lack = ("tells", "lacks") if len(lost) == 1 else ("tell", "lack")
        end += f" {enumerated(lost)} {tells} about as much, but {lack} something."
    return end


def _told(measured: _Measured, r2: float, how_well: str = "an R²") -> str:
    """What is told, and how well, beside the full observation."""
    return (
        f"{measured.what} with {how_well} of {r2_text(r2)} (the full one: {r2_text(measured.full)})"
    )


def _measured(evaluation: Evaluation) -> _Measured | None:
    """By the first measure that the full observation tells anything of; None if there is none."""
    steps = evaluation.encoders[FULL].horizon
    for name, what in _MEASURES.items():
        scores = {label: known.ahead(name) for label, known in evaluation.encoders.items()}
        known = {label: (score and score.value) or 0.0 for label, score in scores.items()}
        if (full := known.pop(FULL)) >= _TOLD:
            ranked = sorted(known.items(), key=lambda item: -item[1])
            return _Measured(
                f"{what} over the next {counted(steps or 0, 'step')}", dict(ranked), full
            )
    return None


def untold(evaluation: Evaluation) -> str:
    """Why nothing is known of what a controller needs; empty if something is."""
    if any(evaluation.needs.values()):
        return ""
    full = evaluation.encoders[FULL].prediction
    if not full:
        return "episodes are too short to look ahead"
    if all(ahead.reward.value is None for ahead in full.values()):
        return "no reward is known that varies over the held-out steps, and no --policy is given"
    return "the reward of these steps can't be predicted, and no --policy says what it looks at"


def unreadable(evaluation: Evaluation) -> tuple[Lost, ...]:
    """What a controller needs and can't be read from the full observation itself."""
    return evaluation.encoders[FULL].loses


def lacking(evaluation: Evaluation) -> dict[str, list[Lost]]:
    """What each code lacks that the full observation has, the most needed first."""
    beyond = {each.name for each in unreadable(evaluation)}
    return {
        label: [each for each in known.loses if each.name not in beyond]
        for label, known in evaluation.encoders.items()
        if label != FULL
    }
