"""An evaluation of encoders as tables to read on a screen."""

from collections.abc import Callable, Iterator, Mapping

from jbrep.encoders import FULL
from jbrep.evaluate.evaluation import Diagnostics, Evaluation, Score, Scores, Worth
from jbrep.evaluate.table import SCALARS
from jbrep.jitterbug.tasks import TASKS
from jbrep.report.serving import falling_short, lacking, serving, unreadable, untold
from jbrep.report.worth import advice, conditioning, ranked
from jbrep.report.worth import title as worth_title
from jbrep.text import SIGNIFICANT, Table, counted, facts, html, interval, number, r2_text, wrapped

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

_COLUMNS: dict[str, tuple[str, Callable[[Diagnostics], Score | None]]] = {  # of the headline
    "forward": ("the features' change over {}, from code and actions", lambda e: e.ahead("mean")),
    "rewarded": ("of that, what the reward depends on", lambda e: e.ahead("rewarded")),
    "reward": ("the mean reward of these steps", lambda e: e.ahead("reward")),
    "value": ("the discounted return to go", SCALARS["value"].read),
    "action": ("the action", SCALARS["action"].read),
}
_OF_POLICY = ("value", "action")
_LACKING = "What each lacks of what a controller needs (R² of reading it below .5)"
_NOTHING_NOW = "nothing: it can all be read now, but what becomes of it less well"
_UNKNOWN = Score(None, None, None)
_NOISE = 0.1  # the level of corruption that is shown
_MANY = 8  # quantities from which probes are summed up


def evaluation_text(
    evaluation: Evaluation, width: int | None = None, everything: bool = False
) -> str:
    """Which code to take and what each lacks, in lines of that width; everything else if wanted."""
    parts = [
        part.text(width) if isinstance(part, Table) else part for part in _parts(evaluation, width)
    ]
    if everything:
        encoders = evaluation.encoders
        tables = _errors(evaluation), _readings(encoders), _units(encoders)
        parts += [_columns(evaluation, width), *(each.text(width) for each in tables)]
    return "\n\n".join(parts)


def evaluation_html(evaluation: Evaluation) -> str:
    """Which code to take and what each lacks, for a notebook."""
    return html(*_parts(evaluation, None))


def _parts(evaluation: Evaluation, width: int | None) -> Iterator[str | Table]:
    """What tells codes that serve from others; first what they are worth, if that is known."""
    tables = _headline(evaluation), *_unseen(evaluation)
    if evaluation.worth and evaluation.worth.returns:
        yield _worths(evaluation, evaluation.worth, width)
        yield from tables
    else:
        yield wrapped(serving(evaluation), width)
        yield from tables
        yield _lacking(evaluation, width)


def _headline(evaluation: Evaluation) -> Table:
    """What tells codes that serve from others: columns of which anything is known."""
    data = evaluation.data
    scores = {
        label: {name: read(known) or _UNKNOWN for name, (_, read) in _COLUMNS.items()}
        for label, known in evaluation.encoders.items()
    }
    shown = [name for name in _COLUMNS if any(e[name].value is not None for e in scores.values())]
    return Table(
        f"R² on {counted(data.test_episodes, 'held-out episode')} ({data.test_rows:,} steps), "
        "nonlinear (1: all, 0: nothing)",
        ("encoder", "size", *shown),
        [
            (
                label,
                str(evaluation.encoders[label].latent),
                *(_told(each[name], name) for name in shown),
            )
            for label, each in scores.items()
        ],
    )


def _told(score: Score, name: str) -> str:
    """An R² of the headline; that by which codes are chosen with its interval."""
    value, low, high = score
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


def _columns(evaluation: Evaluation, width: int | None) -> str:
    """What the columns of the headline are."""
    steps = counted(evaluation.encoders[FULL].horizon or 0, "step")
    named = {
        name: words.format(steps) + (f" of {evaluation.policy}" if name in _OF_POLICY else "")
        for name, (words, _) in _COLUMNS.items()
        if evaluation.policy or name not in _OF_POLICY
    }
    return facts(named, width, indent=0)


def _worths(evaluation: Evaluation, worth: Worth, width: int | None) -> str:
    """Which code to take, and a line for each: its mean return, and why it isn't more."""
    found = ranked(worth)
    lacks = {} if untold(evaluation) else _lacks(evaluation)
    lines = {}
    for label in found.means:
        why = [f"lacks {lacks[label]}"] if lacks.get(label) else []
        if label not in found.best:
            why += filter(None, [conditioning(evaluation.encoders[label].latent_units)])
            why = why or ["why isn't known"]
        lines[label] = "; ".join((interval(worth.returns[label], SIGNIFICANT), *why))
    title = worth_title(worth) + (f". {_LACKING}" if lacks else "")
    told = facts(lines, width, indent=0)
    advised = wrapped(advice(evaluation, found), width) + "\n"
    return "\n".join((advised, wrapped(title, width), told, *_unsaid(evaluation, width)))


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
