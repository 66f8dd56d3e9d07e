"""An evaluation of encoders to read on a screen: the recommended one, and what each misses."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from jbrep.encoders import FULL
from jbrep.evaluation.diagnosis import SCALARS
from jbrep.evaluation.evaluation import Diagnostics, Evaluation, Lost, Score
from jbrep.reporting.views import ADVICE, say
from jbrep.text import Table, facts, number, r2_text, wrapped

_MEASURES = {  # the first that the full observation predicts decides
    "rewarded": "the change of what the reward depends on",
    "reward": "the reward",
    "mean": "the features' change",
}
_PREDICTED = 0.1  # least R² that counts as predicted
AS_GOOD = 0.9  # share of the best R² that is enough
_MANY = 8  # features that are named


class Advice(NamedTuple):
    """Which encoders retain enough for a controller."""

    by: str  # what decides, in words
    enough: Sequence[str] = ()  # encoders that do, best first
    recommended: str | None = None  # the smallest of these, if possible one that misses nothing
    nearest: str | None = None  # where none does, the one that comes nearest, if any
    unknown: str = ""  # why nothing can be said; empty where something can


def evaluation_text(
    evaluation: Evaluation, width: int | None = None, everything: bool = False
) -> str:
    """What is recommended and what each misses, at most that wide; everything else if wanted."""
    parts = [*_parts(evaluation, width), *(_everything(evaluation, width) if everything else ())]
    return "\n\n".join(
        part.text(width) if isinstance(part, Table) else part for part in parts if part
    )


def _parts(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    judged = judge(evaluation)
    yield wrapped(say("advice", judged), width)
    yield _headline(evaluation, judged)
    yield from _hidden(evaluation)
    yield _missed_text(evaluation, width)


def judge(evaluation: Evaluation) -> Advice:
    """By what each encoder predicts, compared with the best, the full observation among them."""
    horizon = evaluation.encoders[FULL].horizon
    for name in _MEASURES:
        scores = {label: known.ahead(name) for label, known in evaluation.encoders.items()}
        r2 = {label: (score and score.value) or 0.0 for label, score in scores.items()}
        if r2[FULL] >= _PREDICTED:
            break
    else:
        unpredictable = (
            f"even the full observation predicts almost nothing on these "
            f"{evaluation.data.test_rows:,} held-out steps"
        )
        return Advice("", unknown=unpredictable if horizon else untold(evaluation))
    by = f"R² of {_MEASURES[name]} over {horizon} steps, at least {AS_GOOD:.0%} of the best"
    misses, threshold = missed(evaluation), AS_GOOD * max(r2.values())
    ranked = sorted((label for label in r2 if label != FULL), key=lambda label: -r2[label])
    enough = [label for label in ranked if r2[label] >= threshold]
    nearest = next((label for label in ranked if r2[label] >= _PREDICTED), None)
    complete = [label for label in enough if not misses[label]]
    size = {label: evaluation.encoders[label].latent for label in enough}
    return Advice(by, enough, min(complete or enough, key=size.__getitem__, default=None), nearest)


def _headline(evaluation: Evaluation, judged: Advice) -> Table:
    encoders = evaluation.encoders
    first = [name for name, scalar in SCALARS.items() if scalar.is_first]
    names = [n for n in first if any(_score(e, n).value is not None for e in encoders.values())]
    enough = dict.fromkeys(encoders, "no") | dict.fromkeys(judged.enough, "yes") | {FULL: "-"}
    rows = [
        (
            *(label, str(known.latent), *(_r2(known, name) for name in names)),
            "-" if judged.unknown else enough[label],
        )
        for label, known in encoders.items()
    ]
    title = say("headline", evaluation, judged)
    return Table(title, ("encoder", "size", *names, "enough"), rows)


def _score(known: Diagnostics, name: str) -> Score:
    return known.scores.get(name, Score(None))


def _r2(known: Diagnostics, name: str) -> str:
    """An R² of the headline; that by which codes are chosen with its interval."""
    value, low, high = _score(known, name)
    is_chosen_by = name == ADVICE and low is not None
    return r2_text(value) + (f" [{r2_text(low)}, {r2_text(high)}]" if is_chosen_by else "")


def _hidden(evaluation: Evaluation) -> Iterator[Table]:
    codes = evaluation.encoders.values()
    if hidden := evaluation.data.hidden:
        rows = [(n, *(r2_text(e.nonlinear_probes[n].value) for e in codes)) for n in hidden]
        title = "What isn't observed, predicted from the latent: R², nonlinear"
        yield Table(title, ("feature", *evaluation.encoders), rows)


def _missed_text(evaluation: Evaluation, width: int | None) -> str:
    if reason := untold(evaluation):
        return wrapped(f"What each misses isn't known: {reason}.", width)
    found = {}
    for label, features in missed(evaluation).items():
        some = [f"{each.name} ({r2_text(each.kept)})" for each in features[:_MANY]]
        more = [f"{len(features) - _MANY} more"] if len(features) > _MANY else []
        found[label] = ", ".join((*some, *more)) or "nothing"
    unread = [each.name for each in evaluation.encoders[FULL].loses]
    title = wrapped("What each misses of what a controller needs (decoded with R² < 0.5)", width)
    nor = f"The full observation doesn't show {', '.join(unread)} either."
    lines = [title, facts(found, width, indent=0)] if found else []
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


def missed(evaluation: Evaluation) -> dict[str, list[Lost]]:
    """What each encoder misses that the full observation has, the most needed first."""
    beyond = {each.name for each in evaluation.encoders[FULL].loses}
    return {
        label: [each for each in known.loses if each.name not in beyond]
        for label, known in evaluation.encoders.items()
        if label != FULL
    }


def _everything(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    others = [name for name, scalar in SCALARS.items() if not scalar.is_first]
    rows = [
        (label, *(number(_score(known, name).value) for name in others))
        for label, known in evaluation.encoders.items()
    ]
    yield Table("All other diagnostics", ("encoder", *others), rows)
    yield facts({name: scalar.words for name, scalar in SCALARS.items()}, width, 0)
