"""An evaluation of encoders as tables to read on a screen."""

import sys
from collections.abc import Iterator, Mapping

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Diagnostics, Evaluation, Learned, Scores, Worth
from jbrep.evaluate.table import headline
from jbrep.jitterbug.tasks import TASKS
from jbrep.report.serving import lacking, serving, unreadable, untold, valued
from jbrep.text import Table, counted, facts, html, interval, number, r2_text, wrapped

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

_COLUMNS = {  # of the headline
    "forward": "the features' change over 10 steps, from code and actions",
    "rewarded": "of that, what the reward depends on",
    "reward": "the mean reward of these steps",
    "value": "the discounted return to go",
    "action": "the action",
}
_OF_POLICY = ("value", "action")
_LACKING = "What each lacks of what a controller needs (R² of reading it below .5)"
_NOISE = 0.1  # the level of corruption that is shown
_MANY = 8  # quantities from which probes are summed up


def evaluation_text(
    evaluation: Evaluation, width: int | None = None, everything: bool = False
) -> str:
    """Which codes serve and what each lacks, in lines of that width; everything else if wanted."""
    worth = evaluation.worth
    parts = [
        *((wrapped(valued(evaluation, worth), width), _worth(worth).text(width)) if worth else ()),
        wrapped(serving(evaluation), width),
        _headline(evaluation).text(width),
        *(table.text(width) for table in _unseen(evaluation)),
        _lacking(evaluation, width),
    ]
    if everything:
        encoders = evaluation.encoders
        tables = _errors(evaluation), _readings(encoders), _units(encoders)
        parts += [_columns(evaluation, width), *(each.text(width) for each in tables)]
    return "\n\n".join(parts)


def evaluation_html(evaluation: Evaluation) -> str:
    """Which codes serve and what each lacks, for a notebook."""
    worth = evaluation.worth
    first = (valued(evaluation, worth), _worth(worth)) if worth else ()
    tables = _headline(evaluation), *_unseen(evaluation)
    return html(*first, serving(evaluation), *tables, _lacking(evaluation, None))


def _headline(evaluation: Evaluation) -> Table:
    """What tells codes that serve from others: columns of which anything is known."""
    data = evaluation.data
    numbers = {label: headline(known) for label, known in evaluation.encoders.items()}
    shown = [c for c in _COLUMNS if any(each[c] is not None for each in numbers.values())]
    return Table(
        f"R² on {counted(data.test_episodes, 'held-out episode')} ({data.test_rows:,} steps), "
        "nonlinear (1: all, 0: nothing)",
        ("encoder", "size", *shown),
        [
            (
                label,
                str(evaluation.encoders[label].latent),
                *(r2_text(each[name]) for name in shown),
            )
            for label, each in numbers.items()
        ],
    )


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


def _worth(worth: Worth) -> Table:
    """What each code returns, by way of learning; first, and learned again with own steps."""
    where = "as the data let estimate them" if worth.estimated else f"of {worth.episodes} episodes"
    agents = f"; of agents after {worth.steps:,} steps, {worth.runs} runs" if worth.runs else ""
    labels = next(iter(worth.learned.values()))
    return Table(
        f"Mean returns {where}{agents}",
        ("encoder", *worth.learned),
        [(label, *(_returned(each[label]) for each in worth.learned.values())) for label in labels],
    )


def _returned(each: Learned) -> str:
    shown = interval(each.score, ".0f")
    return shown if each.again is None else f"{shown}, then {interval(each.again, '.0f')}"


def _columns(evaluation: Evaluation, width: int | None) -> str:
    """What the columns of the headline are."""
    named = {
        name: words + (f" of {evaluation.policy}" if name in _OF_POLICY else "")
        for name, words in _COLUMNS.items()
        if evaluation.policy or name not in _OF_POLICY
    }
    return facts(named, width or sys.maxsize, indent=0)


def _lacking(evaluation: Evaluation, width: int | None) -> str:
    """What each code lacks of what a controller needs, as far as that can be said."""
    if reason := untold(evaluation):
        return wrapped(f"What each lacks can't be said: {reason}.", width)
    task = evaluation.data.task
    lines = {}
    for label, features in lacking(evaluation).items():
        said: dict[str, float] = {}
        for each in features:
            said.setdefault(in_words(task, each.name), each.kept)
        more = len(said) - _MANY
        some = [f"{words} ({r2_text(kept)})" for words, kept in list(said.items())[:_MANY]]
        lines[label] = ", ".join(some) + (f" and {more} more" if more > 0 else "") or "nothing"
    told = f"{wrapped(_LACKING, width)}\n{facts(lines, width or sys.maxsize, indent=0)}"
    if unread := dict.fromkeys(in_words(task, each.name) for each in unreadable(evaluation)):
        nor = f"Not even from the full observation can be read here: {', '.join(unread)}."
        told += f"\n{wrapped(nor, width)}"
    return told


def in_words(task: str, feature: str) -> str:
    """What to call a feature to a reader; several of the Jitterbug's share their words."""
    words = _WORDS if task in TASKS else {}
    return words.get(feature, feature)


def _errors(evaluation: Evaluation) -> Table:
    data = evaluation.data
    header = ("encoder", "l", "error", "times PCA's", f"from noise {_NOISE}", "best linear")
    rows = []
    for label, known in evaluation.encoders.items():
        error = known.reconstruction
        if label == FULL:
            continue
        if error is None or known.corruption is None:
            rows.append((label, str(known.latent), *["-"] * (len(header) - 1)))
            continue
        noisy = next(each for each in known.corruption if each.noise == _NOISE)
        worst = min(error.features, key=lambda f: (f.r2.value is None, f.r2.value))
        rows.append(
            (
                label,
                str(known.latent),
                interval(error.mse, ".5f"),
                interval(error.ratio_to_pca, ".3f") if error.ratio_to_pca else "-",
                number(noisy.mse.value, ".5f"),
                number(noisy.linear_mse.value, ".5f"),
                f"{worst.name} {r2_text(worst.r2.value)}",
            )
        )
    return Table(
        f"Error on {counted(data.test_episodes, 'held-out episode')} of {data.task} "
        f"({data.test_rows:,} rows), features scaled to [-1, 1], with 95 % intervals over "
        "episodes",
        (*header, "worst feature, R²"),
        rows,
    )


def _drawn(encoders: _Encoders) -> str:
    """How many dimensions of the state the GTC looks at, if not at all."""
    gtc = encoders[FULL].correlation
    judged, whole = len(gtc.dimensions), gtc.state_dimensions
    return f"; {judged} of its {whole} dimensions" if judged < whole else ""


def _readings(encoders: _Encoders) -> Table:
    probes = {label: _probes(known.probes) for label, known in encoders.items()}
    rows = [
        (
            label,
            *probes[label].values(),
            number(known.neighbours.mse.value, ".2f"),
            number(known.correlation.mean.value, ".2f"),
            r2_text(known.dynamics.linear.value),
        )
        for label, known in encoders.items()
    ]
    return Table(
        "What can be read from the latent: R² of linear probes; KNN-MSE (2: nothing); GTC (1: the "
        f"units are the state itself{_drawn(encoders)}); R² of the next latent, whitened",
        ("encoder", *probes[FULL], "KNN-MSE", "GTC", "next"),
        rows,
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


def _units(encoders: _Encoders) -> Table:
    return Table.of(
        "Latent units: dead ones, the most saturated one, participation ratio, intrinsic dimension",
        [(label, known.latent_units) for label, known in encoders.items()],
        {
            "encoder": lambda each: each[0],
            "dead": lambda each: str(len(each[1].dead)),
            "saturated": lambda each: number(max(each[1].saturation or (), default=None), ".0%"),
            "participation": lambda each: number(each[1].participation_ratio, ".1f"),
            "TwoNN": lambda each: number(each[1].intrinsic_dimension.two_nn, ".1f"),
            "max. likelihood": lambda each: number(each[1].intrinsic_dimension.mle, ".1f"),
        },
    )
