"""The figures of a study: a table of plots, and the tables that these are drawn from."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, MaxNLocator

from jbrep.reporting.figures.panels import (
    Key,
    Limits,
    Look,
    Mark,
    Plot,
    Row,
    by,
    column,
    fitting,
    line,
    panels,
    reference,
    styles,
)
from jbrep.reporting.findings import Findings, Group
from jbrep.stats.claims import CLAIMS
from jbrep.stats.runs import in_order

_GROUP = ("task", "algorithm")
_JITTER = 0.14  # between the outermost runs and the middle of their row
_SPREAD = "SD over runs"
_ENDS = ("value", "low", "high")
_DASHED = " Dashed: policies that don't learn."
_DOTTED = " Dotted: the return that counts as solved."


class _Spec(NamedTuple):
    name: str
    title: str
    caption: str
    rows: Callable[[Findings], Iterator[Row]]
    mark: Mark
    axis_labels: tuple[str, str]
    facet: tuple[str, ...] = _GROUP
    values: tuple[str, ...] = ()  # columns of returns, over which an axis extends
    ends: tuple[str, ...] = ()  # likewise, but not far beyond the others
    together: tuple[str, ...] = _GROUP  # what panels with the same limits share
    played: Callable[[Group], Mapping[str, float]] | None = None  # returns of policies beside it
    more: Mapping[str, Any] = {}  # arguments of `panels`


def study_plots(found: Findings) -> list[Plot]:
    """The figures that a study allows; a representation has one colour in all."""
    names = in_order(found.representations, found.baseline)
    looks = styles(names, found.baseline if found.baseline in names else None)
    legend = {name: f"{name} (n = {_counts(found, name)})" for name in names}
    plots = [_plot(spec, found, looks, legend) for spec in _PLOTS]
    return [plot for plot in plots if plot.rows]


def _counts(found: Findings, representation: str) -> str:
    labels = [run.label for run in found.runs if run.label.rpartition("/")[2] == representation]
    counts = sorted({labels.count(label) for label in labels})
    return "\N{EN DASH}".join(map(str, dict.fromkeys((*counts[:1], *counts[-1:]))))


def _plot(
    spec: _Spec, found: Findings, looks: Mapping[str, Look], names: Mapping[str, str]
) -> Plot:
    rows = [*spec.rows(found)]
    groups = {(group.task, group.algorithm): group for group in found.groups}
    lines, limits = dict[Key, Mapping[str, float]](), dict[Key, Limits]()
    for together in by(rows, *spec.together).values() if spec.values else ():
        values = [each for name in spec.values for each in column(together, name)]
        is_spread = _SPREAD in together[0].values()
        if is_spread:
            most = 3 * max(column(together, "mean"))
            values += [0, *column(together, "mean_high").clip(max=most)]
        ends, solved = [end for name in spec.ends for end in column(together, name)], list[float]()
        own = by(together, *spec.facet)
        for key in own if not is_spread else ():
            if spec.played and (group := groups.get(key[:2])):
                lines[key] = spec.played(group)
                values += lines[key].values()
                values += [] if group.return_floor is None else [group.return_floor]
                solved += [] if group.solved is None else [group.solved]
        limits |= dict.fromkeys(own, extent := fitting(values, ends, solved))
        for key in own if solved and extent[0] <= solved[0] <= extent[1] else ():
            lines[key] = {**lines.get(key, {}), "solved": solved[0]}
    draw = partial(panels, mark=spec.mark, facet=spec.facet, axis_labels=spec.axis_labels)
    how: dict[str, Any] = {"series": "representation", "looks": looks, "names": names}
    if (several := len(found.algorithms)) > 1 and spec.facet == _GROUP:
        how |= {"across": min(several, 6), "title": ",\n".join}
    draw = partial(draw, lines=lines, limits=limits, **{**how, **spec.more})
    drawn = {name for each in lines.values() for name in each}
    caption = spec.caption + _DASHED * bool(drawn - {"solved"}) + _DOTTED * ("solved" in drawn)
    return Plot(spec.name, spec.title, caption, rows, draw)


# tables


def _agents(found: Findings) -> Iterator[tuple[Group, Any, dict[str, Any]]]:
    """The runs of each representation in each group, and what their rows begin with."""
    for group in found.groups:
        for each in group.agents:
            key = {"task": group.task, "algorithm": group.algorithm}
            yield group, each, {**key, "representation": each.representation}


def _final(found: Findings) -> Iterator[Row]:
    """Each run's final return with the mean of all; and their spread."""
    for _, each, key in _agents(found):
        mean, sd = (_numbers("mean", each.numbers[f"final_return_{n}"]) for n in ("mean", "sd"))
        for seed, value in zip(each.seeds, each.by_run["final_return"], strict=True):
            yield {**key, "number": "final return", "seed": seed, "value": value, **mean}
        yield {**key, "number": _SPREAD, "seed": None, "value": None, **sd}


def _curves(found: Findings) -> Iterator[Row]:
    for group, each, key in _agents(found):
        curve = [each.curve[name] for name in ("p10", "mean", "p90", "iqm")]
        final = each.numbers["final_return_mean"].value
        for step, low, mean, high, iqm in zip(group.grid, *curve, strict=True):
            of_runs = {"p10": low, "mean": mean, "p90": high}
            ended = final if step == group.grid[-1] else None
            yield {**key, "step": int(step), **of_runs, "final": ended, **_numbers("iqm", iqm)}


def _numbers(name: str, values: Sequence[float | None]) -> dict[str, float | None]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))


def _every_run(found: Findings) -> Iterator[Row]:
    for run in found.runs:
        key = dict(zip((*_GROUP, "representation"), run.label.rsplit("/", 2), strict=True))
        for step, mean in run.curve:
            yield {**key, "seed": run.seed, "step": step, "mean_return": mean}


def _differences(found: Findings) -> Iterator[Row]:
    """Those that claims are held against, or else from the baseline."""
    for group in found.groups:
        rows: list[tuple[Any, ...]] = [
            (v.x, v.sentence, v.estimate, v.interval, v.boundary)
            for v in found.verdicts_of(group.task, group.algorithm)
            if CLAIMS[v.claim].is_of_returns and v.estimate.value is not None
        ]
        untested, difference = (None, None, None), "final_return_difference"
        rows = rows or [
            (name, f"{name} - {found.baseline}", each.numbers[difference], untested, 0.0)
            for each in group.compared
            for name in [each.representation]
        ]
        for name, claim, estimate, tested, boundary in rows:
            key = {"task": group.task, "algorithm": group.algorithm, "representation": name}
            ends = {**_numbers("difference", estimate), **_numbers("tested", tested)}
            yield {**key, "claim": claim, **ends, "boundary": boundary}


def _profiles(found: Findings) -> Iterator[Row]:
    """Of final returns, and of scores across tasks."""
    for group, each, key in _agents(found):
        for at, share in zip(group.profile_returns, each.profile, strict=True):
            of_group = {**key, "number": "final return", "at": at}
            yield {**of_group, **dict(zip(_ENDS, share, strict=True))}
    for one in found.aggregates:
        key = {"task": f"{len(one.tasks)} tasks", "algorithm": one.algorithm}
        for at, share in zip(one.scores, one.profile, strict=True):
            of_all = {**key, "representation": one.representation, "number": "score", "at": at}
            yield {**of_all, **dict(zip(_ENDS, share, strict=True))}


def _diagnosed(found: Findings) -> Iterator[Row]:
    names = ("representation", "value", "final_return", "family")
    for each in found.diagnostics:
        key = {"task": each.task, "algorithm": each.algorithm, "diagnostic": each.diagnostic}
        ranks = _numbers("rank_correlation", each.correlation)
        codes = each.representations, each.values, each.final_returns, each.families
        for code in zip(*codes, strict=True):
            words = {"words": each.words, "better": each.better}
            yield {**key, **dict(zip(names, code, strict=True)), **ranks, **words}


# marks and panels of single plots


def _runs_and_mean(axes: Axes, rows: Sequence[Row], look: Look, _: str, place: int) -> None:
    """A point for each run, and below them their mean with its interval, in a row."""
    points = column(rows, "value")
    apart = np.linspace(-_JITTER, _JITTER, len(points)) * (len(points) > 1)
    axes.plot(points, place - 0.2 + apart, ".", color=look["color"], ms=4, alpha=0.6, mew=0)
    _interval(axes, rows[0], "mean", look, 1.4, place + 0.2)


def _difference(axes: Axes, rows: Sequence[Row], look: Look, _: str, place: int) -> None:
    """The interval of the test, that of 95 %, and the boundary, in a row."""
    tested = {f"difference_{end}": rows[0][f"tested_{end}"] for end in ("low", "high")}
    _interval(axes, {**rows[0], **tested}, "difference", look, 0.8, place)
    _interval(axes, rows[0], "difference", look, 2, place)
    axes.plot([rows[0]["boundary"]] * 2, [place - 0.45, place + 0.45], **reference())


def _interval(axes: Axes, row: Row, name: str, look: Look, width: float, place: float) -> None:
    """A number between its low and high ends; triangles where it leaves the panel."""
    value, low, high = np.array([row[name], row[f"{name}_low"], row[f"{name}_high"]], float)
    left, right = axes.get_xlim()

    def draw(at: Any, **how: Any) -> None:
        axes.plot(np.clip(at, left, right), [place] * len(at), color=look["color"], **how)

    draw([low, high], lw=width)
    draw([value], marker=look["marker"], ms=4)
    for edge, marker, is_cut in (left, "<", low < left), (right, ">", high > right):
        if is_cut:
            draw([edge], marker=marker, ms=3.5, mew=0, clip_on=False, zorder=5)


def _training(axes: Axes, rows: Sequence[Row]) -> None:
    axes.set_xlim(0, max(1, *column(rows, "step")))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_locator(MaxNLocator(5))


def _ranked(key: Key) -> str:
    task, _, diagnostic, correlation = key
    return f"{task}\n{diagnostic}" + (f" ({correlation:.2f})" if correlation is not None else "")


def _better_right(axes: Axes, rows: Sequence[Row]) -> None:
    axes.set_xlabel(fill(rows[0]["words"], 24), size=6)
    if rows[0]["better"] < 0:
        axes.invert_xaxis()


_PLOTS = (
    _Spec(
        "final_return",
        "Final return and its spread",
        "Mean return at the end of training, a point for each of n runs, and their mean; beside "
        "it, the standard deviation over runs. Bars: 95 % intervals, from four runs on; a triangle "
        "at an edge: the interval goes beyond it.",
        _final,
        _runs_and_mean,
        ("number", ""),
        facet=(*_GROUP, "number"),
        values=("value", "mean"),
        ends=("mean_low", "mean_high"),
        together=(*_GROUP, "number"),
        played=lambda group: {name: mean.value or 0.0 for name, mean in group.references.items()},
        more={
            **{"title": lambda key: ", ".join(key[:2]), "across": 2},
            **{"height": 0.6, "row": 0.2},
        },
    ),
    _Spec(
        "representations",
        "Return over training by representation",
        "Return of the deterministic policy over training: mean and 10 to 90 % over n runs. The "
        "diamond at the end is the final return of the table.",
        _curves,
        line("step", "mean", "p10", "p90", final="final"),
        ("training step", "return"),
        values=("p10", "p90", "final"),
        together=("task",),
        played=lambda group: group.in_training,
        more={"finish": _training},
    ),
    _Spec(
        "differences",
        "Differences of final returns",
        "Of registered claims, or else from the baseline, seed by seed. Thick: 95 % interval; "
        "thin: the interval of the test that was made; dashed: the boundary, which it must not "
        "hold. A triangle at an edge: the interval goes beyond it.",
        _differences,
        _difference,
        ("difference of final returns", ""),
        values=("difference", "difference_low", "difference_high", "boundary"),
        ends=("tested_low", "tested_high"),
        more={
            **{"series": "claim", "colour": "representation", "across": 1},
            **{"height": 0.6, "row": 0.16},
        },
    ),
    _Spec(
        "profiles",
        "Performance profiles",
        "The share of n runs whose final return, or across tasks whose score, is above that on the "
        "axis, with its 95 % bootstrap interval (Agarwal et al. 2021). Higher is better; steep is "
        "steady.",
        _profiles,
        line("at", *_ENDS, drawstyle="steps-post", marker=""),
        ("number", "share of runs above"),
    ),
    _Spec(
        "diagnostics",
        "Final return against diagnostics",
        "Each representation by each diagnostic, better ones to the right, with its mean final "
        "return. In brackets, where there are five or more: the rank correlation, 1 if the better "
        "value always goes with the higher return.",
        _diagnosed,
        line("value", "final_return", linestyle="none", ms=4, markevery=1),
        ("words", "final return"),
        facet=(*_GROUP, "diagnostic", "rank_correlation"),
        more={"title": _ranked, "across": 5, "height": 1.7, "finish": _better_right},
    ),
    _Spec(
        "every_run",
        "Every run",
        "Mean return of each evaluation, a line for each run.",
        _every_run,
        line("step", "mean_return", marker="", lw=0.8, alpha=0.7, label="_"),
        ("training step", "return"),
        facet=(*_GROUP, "representation"),
        values=("mean_return",),
        together=("task",),
        played=lambda group: group.in_training,
        more={
            **{"series": "seed", "colour": "representation", "across": 4, "height": 1.5},
            **{"finish": _training, "title": ",\n".join},
        },
    ),
)
