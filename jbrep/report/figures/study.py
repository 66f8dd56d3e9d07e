"""All figures of a study."""

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from jbrep.encoders import FULL
from jbrep.report.figures.curves import Played, across_tasks, curves, every_run
from jbrep.report.figures.diagnostics import diagnostics
from jbrep.report.figures.diagrams import diagrams
from jbrep.report.figures.differences import difference_plot, differences
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.returns import final_return, learning_rate, profiles
from jbrep.report.figures.style import styles
from jbrep.stats import Analysis
from jbrep.stats.association import Association
from jbrep.stats.intervals import FEWEST_RUNS
from jbrep.stats.runs import in_order
from jbrep.study.record import Label
from jbrep.study.tables import References, Return, by_run


def study_plots(
    analysis: Analysis | None,
    returns: Sequence[Return],
    references: References,
    labels: Mapping[str, Label],
    associations: Sequence[Association] = (),
) -> list[Plot]:
    """The figures that the tables of a study allow; a representation has one colour in all."""
    baseline = analysis.baseline if analysis else FULL
    groups = analysis.groups if analysis else ()
    names = {
        *(row.representation for row in returns),
        *(label.representation for group in groups for label in group.labels),
        *(shared.settings.representation for shared in labels.values()),
    }
    looks = partial(styles, in_order(names, baseline), baseline if baseline in names else None)
    plots, played = [], _on_all_starts(references, returns)
    if analysis:
        plots += [final_return(groups, looks), curves(groups, played, looks)]
        if differences(analysis):
            plots.append(difference_plot(analysis, looks))
        plots.append(learning_rate(groups, played, looks))
        if any(len(label.seeds) >= FEWEST_RUNS for group in groups for label in group.labels):
            plots.append(profiles(analysis, looks))
        if analysis.aggregates:
            plots.append(across_tasks(analysis, looks))
    if associations:
        plots.append(diagnostics(associations, looks))
    if returns:
        plots.append(every_run(returns, played, looks))
    return [*plots, *diagrams(labels, looks)]


def _on_all_starts(references: References, returns: Sequence[Return]) -> Played:
    """Means of policies that don't learn, for tasks whose curves are of the same starts.

    Where only the last evaluation has all starts, curves of the others can't stand beside them.
    """
    fewest: dict[str, int] = {}
    for (label, _), by_step in by_run(returns).items():
        task, count = label.rsplit("/", 2)[0], min(map(len, by_step.values()))
        fewest[task] = min(fewest.get(task, count), count)
    return {
        task: {policy: float(np.mean(each)) for policy, each in played.items()}
        for task, played in references.items()
        if all(len(each) == fewest.get(task) for each in played.values())
    }
