"""Results across tasks: the share of runs above each score."""

from matplotlib.figure import Figure

from jbrep.report.figures.curves import below, cell
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.style import Looks, panel_grid, plain, reference, with_runs
from jbrep.stats.analysis import Analysis


def across_tasks(analysis: Analysis, looks: Looks) -> Plot:
    """Performance profiles of gains across tasks, a panel for each algorithm."""
    return Plot(
        "across_tasks",
        "Across tasks",
        f"The share of n runs on each task whose gain over standing still is above a share of that "
        f"on {analysis.baseline} (dashed: as good), averaged over tasks, with its 95 % bootstrap "
        "interval (Agarwal et al. 2021).",
        ("algorithm", "representation", "tasks", "score", "share", "low", "high"),
        [
            (each.algorithm, each.representation, ", ".join(each.tasks), *map(cell, row))
            for each in analysis.open_aggregates
            for row in zip(each.scores, *each.profile, strict=True)
        ],
        lambda: _draw(analysis, looks),
    )


def _draw(analysis: Analysis, looks: Looks) -> Figure:
    aggregates = analysis.open_aggregates
    algorithms = list(dict.fromkeys(each.algorithm for each in aggregates))
    figure, panels = panel_grid(len(algorithms), 2.0)
    look = looks()
    for axes, algorithm in zip(panels, algorithms, strict=True):
        axes.axvline(1, **reference())
        own = [each for each in aggregates if each.algorithm == algorithm]
        for each in own:
            colour, (share, low, high) = look[each.representation]["color"], each.profile
            axes.fill_between(each.scores, low, high, step="post", color=colour, alpha=0.12, lw=0)
            name = with_runs(each.representation, [each.runs])
            axes.step(each.scores, share, where="post", color=colour, label=name)
        axes.set_title(plain(f"{algorithm}, {len(own[0].tasks)} tasks"))
        axes.set(ylim=(-0.02, 1.02), xlabel="share of the full agents' gain")
        axes.set(ylabel="share of runs above")
    below(figure, panels)
    return figure
