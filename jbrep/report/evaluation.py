"""An evaluation of encoders as tables to read on a screen."""

from collections.abc import Iterator, Mapping

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Diagnostics, Evaluation, Score, Scores
from jbrep.evaluate.table import SCALARS, Scalar
from jbrep.jitterbug.tasks import TASKS
from jbrep.report.serving import falling_short, lacking, serving, unreadable, untold
from jbrep.text import SIGNIFICANT, Table, counted, facts, html, number, r2_text, wrapped

_Encoders = Mapping[str, Diagnostics]  # by label

_WORDS = {
    "orientation_w": "yaw",
    "orientation_x": "tilt",
    "orientation_y": "tilt",
    "orientation_z": "yaw",
    "velocity_z": "vertical speed",
    "angular_velocity_x": "rate of tilt",
    "angular_velocity_y": "rate of tilt",
    "angular_velocity_z": "rate of yaw",
}

_LACKING = "What each lacks of what a controller needs (R² of reading it below .5)"
_NOTHING_NOW = "nothing: it can all be read now, but what becomes of it less well"
_MANY = 8  # quantities from which probes are summed up


def evaluation_text(
    evaluation: Evaluation, width: int | None = None, everything: bool = False
) -> str:
    """Which code to take and what each lacks, in lines of that width; everything else if wanted."""
    parts = [
        part.text(width) if isinstance(part, Table) else part for part in _parts(evaluation, width)
    ]
    if everything:
        tables = _readings(evaluation.encoders), _scores(evaluation.encoders)
        parts += [each.text(width) for each in tables]
        parts.append(_words(evaluation, width))
    return "\n\n".join(parts)


def evaluation_html(evaluation: Evaluation) -> str:
    """Which code to take and what each lacks, for a notebook."""
    return html(*_parts(evaluation, None))


def _parts(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    """What tells codes that serve from others."""
    yield wrapped(serving(evaluation), width)
    yield _headline(evaluation)
    yield from _unseen(evaluation)
    yield _lacking(evaluation, width)


def _headline(evaluation: Evaluation) -> Table:
    """What tells codes that serve from others: columns of which anything is known."""
    data, encoders = evaluation.data, evaluation.encoders
    shown = [
        each
        for each in SCALARS.values()
        if each.is_first and any(_value(each, e) is not None for e in encoders.values())
    ]
    return Table(
        f"R² on {counted(data.test_episodes, 'held-out episode')} ({data.test_rows:,} steps), "
        "nonlinear (1: all, 0: nothing)",
        ("encoder", "size", *(each.name for each in shown)),
        [
            (label, str(e.latent), *(_told(each.read(e), each.name) for each in shown))
            for label, e in encoders.items()
        ],
    )


def _value(scalar: Scalar, known: Diagnostics) -> float | None:
    score = scalar.read(known)
    return score.value if score else None


def _told(score: Score | None, name: str) -> str:
    """An R² of the headline; that by which codes are chosen with its interval."""
    value, low, high = score or Score(None)
    is_chosen_by = name == "rewarded" and low is not None
    return r2_text(value) + (f" [{r2_text(low)}, {r2_text(high)}]" if is_chosen_by else "")


def _unseen(evaluation: Evaluation) -> Iterator[Table]:
    """How well what isn't seen can be read from each code, where the truth is known."""
    if hidden := evaluation.data.hidden:
        yield Table(
            "What isn't seen, read from the code: R², nonlinear",
            ("feature", *evaluation.encoders),
            [
                (
                    name,
                    *(
                        r2_text(e.nonlinear_probes[name].value)
                        for e in evaluation.encoders.values()
                    ),
                )
                for name in hidden
            ],
        )


def _words(evaluation: Evaluation, width: int | None) -> str:
    """What each diagnostic is; of the headline for as many steps as episodes allow."""
    words = {each.name: each.words for each in SCALARS.values()}
    steps = evaluation.encoders[FULL].horizon
    short = f"\nEpisodes allow to look {steps} steps ahead in place of 10." if steps != 10 else ""
    return facts(words, width, indent=0) + short


def _lacking(evaluation: Evaluation, width: int | None) -> str:
    """What each code lacks of what a controller needs, as far as that can be said."""
    unsaid = _unsaid(evaluation, width)
    if untold(evaluation):
        return "\n".join(unsaid)
    short = falling_short(evaluation)
    lines = {
        label: lacks or (_NOTHING_NOW if label in short else "nothing")
        for label, lacks in _lacks(evaluation).items()
    }
    told = facts(lines, width, indent=0)
    return "\n".join((wrapped(_LACKING, width), told, *unsaid))


def _lacks(evaluation: Evaluation) -> dict[str, str]:
    """What each code lacks, in words."""
    task = evaluation.data.task
    lines = {}
    for label, features in lacking(evaluation).items():
        said: dict[str, float] = {}
        for each in features:
            said.setdefault(in_words(task, each.name), each.kept)
        more = len(said) - _MANY
        some = [f"{words} ({r2_text(kept)})" for words, kept in list(said.items())[:_MANY]]
        lines[label] = ", ".join(some) + (f" and {more} more" if more > 0 else "")
    return lines


def _unsaid(evaluation: Evaluation, width: int | None) -> list[str]:
    """Why it can't be said what each lacks, or what not even the full observation tells."""
    if reason := untold(evaluation):
        return [wrapped(f"What each lacks can't be said: {reason}.", width)]
    task = evaluation.data.task
    unread = dict.fromkeys(in_words(task, each.name) for each in unreadable(evaluation))
    nor = f"Not even from the full observation can be read here: {', '.join(unread)}."
    return [wrapped(nor, width)] if unread else []


def in_words(task: str, feature: str) -> str:
    """What to call a feature to a reader; several of the Jitterbug's share their words."""
    words = _WORDS if task in TASKS else {}
    return words.get(feature, feature)


def _readings(encoders: _Encoders) -> Table:
    probes = {label: _probes(known.probes) for label, known in encoders.items()}
    return Table(
        "What can be read from the latent: R² of linear probes",
        ("encoder", *probes[FULL]),
        [(label, *probes[label].values()) for label in encoders],
    )


def _scores(encoders: _Encoders) -> Table:
    """All diagnostics but those of the headline."""
    others = [each for each in SCALARS.values() if not each.is_first]
    return Table(
        "All other diagnostics",
        ("encoder", *(each.name for each in others)),
        [
            (label, *(number(_value(each, known), SIGNIFICANT) for each in others))
            for label, known in encoders.items()
        ],
    )


def _probes(scores: Scores) -> dict[str, str]:
    """R² of each quantity; of many, of those that vary, the mean and the least."""
    if len(scores) <= _MANY:
        return {name: r2_text(score.value) for name, score in scores.items()}
    known = {name: score.value for name, score in scores.items() if score.value is not None}
    if not known:
        return {"probes, mean": "-", "worst probe": "-"}
    worst = min(known, key=known.__getitem__)
    return {
        "probes, mean": r2_text(sum(known.values()) / len(known)),
        "worst probe": f"{worst} {r2_text(known[worst])}",
    }
