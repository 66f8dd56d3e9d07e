"""All figures of a study."""

from collections.abc import Mapping, Sequence
from typing import Any

from jbrep.encoders import FULL
from jbrep.figures.curves import Heuristics, Return, baseline_curves, curves, every_run
from jbrep.figures.diagrams import Labels, diagrams
from jbrep.figures.plot import Plot
from jbrep.figures.returns import final_return, learning_rate, profiles, variance_ratio


def study_plots(
    statistics: Mapping[str, Any] | None,
    returns: Sequence[Return],
    heuristics: Heuristics,
    labels: Labels,
) -> list[Plot]:
    """The figures that the tables of a study allow.

    Args:
        statistics: statistics.json; None where there are none.
        returns: returns.csv.
        heuristics: returns of the hand-written policy, by task.
        labels: of runs.json.
    """
    plots = []
    baseline = statistics["baseline"] if statistics else FULL
    if statistics:
        groups = statistics["groups"]
        plots += [curves(groups, heuristics), final_return(groups)]
        if any(group["comparisons"] for group in groups):
            level = statistics["simultaneous_level"]
            plots.append(variance_ratio(groups, baseline, level))
        plots += [learning_rate(groups), profiles(groups, statistics["profile_returns"])]
        if any(len(group["labels"]) > 1 for group in groups):
            plots.append(baseline_curves(groups, heuristics))
    return [*plots, every_run(returns, baseline), *diagrams(labels)]
