"""All figures of a study."""

from collections.abc import Mapping, Sequence
from functools import partial

from jbrep.encoders import FULL
from jbrep.report.figures.claims import claim_plot
from jbrep.report.figures.curves import across_tasks, curves, every_run
from jbrep.report.figures.diagnostics import diagnostics
from jbrep.report.figures.diagrams import diagrams
from jbrep.report.figures.plot import Plot
from jbrep.report.figures.returns import final_return, learning_rate, profiles
from jbrep.report.figures.style import styles
from jbrep.stats import Analysis
from jbrep.stats.association import Association
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
    """The figures that the tables of a study allow; a representation has one colour in all.

    Args:
        analysis: the statistics; None if there are none.
        returns: returns.csv.
        references: returns of policies that learn nothing, by task and policy.
        labels: of runs.json.
        associations: of diagnostics with final returns.
    """
    baseline = analysis.baseline if analysis else FULL
    groups = analysis.groups if analysis else ()
    names = {
        *(row.representation for row in returns),
        *(label.representation for group in groups for label in group.labels),
        *(shared.settings.representation for shared in labels.values()),
    }
    looks = partial(styles, in_order(names, baseline), baseline if baseline in names else None)
    plots, shown = [], _on_the_same_starts(references, returns)
    if analysis:
        plots += [curves(groups, shown, looks), final_return(groups, looks)]
        if any(group.comparisons for group in groups):
            plots.append(claim_plot(analysis, looks))
        plots += [learning_rate(groups, looks), profiles(analysis, looks)]
        if analysis.aggregates:
            plots.append(across_tasks(analysis, looks))
    if associations:
        plots.append(diagnostics(associations, looks))
    if returns:
        plots.append(every_run(returns, shown, looks))
    return [*plots, *diagrams(labels, looks)]


def _on_the_same_starts(references: References, returns: Sequence[Return]) -> References:
    """References in the episodes that curves are of; the last evaluation may have more."""
    fewest: dict[str, int] = {}
    for (label, _), by_step in by_run(returns).items():
        task, count = label.rsplit("/", 2)[0], min(map(len, by_step.values()))
        fewest[task] = min(fewest.get(task, count), count)
    return {
        task: {policy: each[: fewest.get(task)] for policy, each in of_task.items()}
        for task, of_task in references.items()
    }
