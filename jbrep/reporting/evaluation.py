"""An evaluation of encoders to read on a screen: which code to take, and what each lacks."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.evaluation.diagnosis import SCALARS
from jbrep.evaluation.evaluation import Diagnostics, Evaluation, Lost, Score
from jbrep.reporting.views import say
from jbrep.text import SIGNIFICANT, Table, facts, number, r2_text, wrapped

_MEASURES = {  # of which the first that the full observation tells anything of counts
    "rewarded": "the change of what the reward depends on",
    "reward": "the reward",
    "mean": "the features' change",
}
_TOLD = 0.1  # R² of it from the full observation, at least
_AS_GOOD = 0.9  # the share of the best R² from which a code serves as well
_MANY = 8  # features that are named
_CHOSEN_BY = "rewarded"  # whose interval is shown


class Judged(NamedTuple):
    """Which codes should serve a controller."""

    by: str  # what decides, in words
    serving: Sequence[str] = ()  # the codes that should, the best first
    take: str | None = None  # the smallest of these, if possible one that lacks nothing
    nearest: str | None = None  # where none serves, the one that comes nearest, if one does
    unsaid: str = ""  # why nothing can be said; empty where something can


def evaluation_text(
    evaluation: Evaluation, width: int | None = None, everything: bool = False
) -> str:
    """Which code to take and what each lacks, in lines of that width; everything else if wanted."""
    parts = [*_parts(evaluation, width), *(_everything(evaluation, width) if everything else ())]
    return "\n\n".join(
        part.text(width) if isinstance(part, Table) else part for part in parts if part
    )


def _parts(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    judged = judge(evaluation)
    yield wrapped(say("advice", judged), width)
    yield _headline(evaluation, judged)
    yield from _hidden(evaluation)
    yield _lacks_text(evaluation, width)


def judge(evaluation: Evaluation) -> Judged:
    """By what can be predicted from each code, beside the best, the full observation among them."""
    horizon = evaluation.encoders[FULL].horizon
    for name in _MEASURES:
        scores = {label: known.ahead(name) for label, known in evaluation.encoders.items()}
        r2 = {label: (score and score.value) or 0.0 for label, score in scores.items()}
        if r2[FULL] >= _TOLD:
            break
    else:
        nothing = (
            f"of these {evaluation.data.test_rows:,} held-out steps even the full observation "
            "tells next to nothing of what comes next"
        )
        return Judged("", unsaid=nothing if horizon else untold(evaluation))
    by = f"R² of {_MEASURES[name]} over {horizon} steps, at least {_AS_GOOD:.0%} of the best"
    lacks, least = lacking(evaluation), _AS_GOOD * max(r2.values())
    codes = sorted((label for label in r2 if label != FULL), key=lambda label: -r2[label])
    serving = [label for label in codes if r2[label] >= least]
    telling = [label for label in codes if r2[label] >= _TOLD]
    nearest = min(telling, key=lambda label: bool(lacks[label]), default=None)
    whole = [label for label in serving if not lacks[label]]
    size = {label: evaluation.encoders[label].latent for label in serving}
    return Judged(by, serving, min(whole or serving, key=size.__getitem__, default=None), nearest)


def _headline(evaluation: Evaluation, judged: Judged) -> Table:
    encoders = evaluation.encoders
    first = [name for name, scalar in SCALARS.items() if scalar.is_first]
    names = [n for n in first if any(_score(e, n).value is not None for e in encoders.values())]
    serves = dict.fromkeys(encoders, "no") | dict.fromkeys(judged.serving, "yes") | {FULL: "-"}
    rows = [
        (
            *(label, str(known.latent), *(_r2(known, name) for name in names)),
            "-" if judged.unsaid else serves[label],
        )
        for label, known in encoders.items()
    ]
    title = say("headline", evaluation, judged)
    return Table(title, ("encoder", "size", *names, "serves"), rows)


def _score(known: Diagnostics, name: str) -> Score:
    return SCALARS[name].read(known) or Score(None)


def _r2(known: Diagnostics, name: str) -> str:
    """An R² of the headline; that by which codes are chosen with its interval."""
    value, low, high = _score(known, name)
    is_chosen_by = name == _CHOSEN_BY and low is not None
    return r2_text(value) + (f" [{r2_text(low)}, {r2_text(high)}]" if is_chosen_by else "")


def _hidden(evaluation: Evaluation) -> Iterator[Table]:
    codes = evaluation.encoders.values()
    if hidden := evaluation.data.hidden:
        rows = [(n, *(r2_text(e.nonlinear_probes[n].value) for e in codes)) for n in hidden]
        title = "What isn't seen, read from the code: R², nonlinear"
        yield Table(title, ("feature", *evaluation.encoders), rows)


def _lacks_text(evaluation: Evaluation, width: int | None) -> str:
    if reason := untold(evaluation):
        return wrapped(f"What each lacks can't be said: {reason}.", width)
    told = {}
    for label, features in lacking(evaluation).items():
        some = [f"{each.name} ({r2_text(each.kept)})" for each in features[:_MANY]]
        more = [f"{len(features) - _MANY} more"] if len(features) > _MANY else []
        told[label] = ", ".join((*some, *more)) or "nothing"
    unread = [each.name for each in evaluation.encoders[FULL].loses]
    title = wrapped("What each lacks of what a controller needs (R² of reading it below .5)", width)
    nor = f"Nor can the full observation tell {', '.join(unread)}."
    lines = [title, facts(told, width, indent=0)] if told else []
    return "\n".join((*lines, *([wrapped(nor, width)] if unread else ())))


def untold(evaluation: Evaluation) -> str:
    """Why nothing is known of what a controller needs; empty if something is."""
    full = evaluation.encoders[FULL].prediction
    if any(evaluation.needs.values()):
        return ""
    if not full:
        return "episodes are too short to look ahead"
    if all(ahead.reward.value is None for ahead in full.values()):
        return "no reward is known that varies over the held-out steps, and no --policy is given"
    return "the reward of these steps can't be predicted, and no --policy says what it looks at"


def lacking(evaluation: Evaluation) -> dict[str, list[Lost]]:
    """What each code lacks that the full observation has, the most needed first."""
    beyond = {each.name for each in evaluation.encoders[FULL].loses}
    return {
        label: [each for each in known.loses if each.name not in beyond]
        for label, known in evaluation.encoders.items()
        if label != FULL
    }


def _everything(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    others = [name for name, scalar in SCALARS.items() if not scalar.is_first]
    rows = [
        (label, *(number(_score(known, name).value, SIGNIFICANT) for name in others))
        for label, known in evaluation.encoders.items()
    ]
    yield Table("All other diagnostics", ("encoder", *others), rows)
    yield facts({name: scalar.words for name, scalar in SCALARS.items()}, width, 0)
