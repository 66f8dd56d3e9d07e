"""How well scores rank codes: python tools/worth.py results/worth-TASK ...

Each folder has the tables of a study of one task and, in scores/, the evaluation of its encoders
from before the first run, and what ways of learning made of the stored data, which did so badly
that jbrep has them no more. A code's score is compared with the mean final return of all its runs
but one, for each that can be left out. The one that is left out is the rival: what a single short
run would have said, which takes as long as to score a code one way, half a minute of CPU time.
Whole runs show the most that one of them can say.

Printed is Spearman's correlation in each task, and its mean over tasks with a 95 % interval over
families of codes, and by how much that is above *rewarded* and above the short run. What was hoped
for was written down before the first run: see PRIMARY. Then how often, of two codes, the one with
more *rewarded* returned more; what the codes returned that are recommended by the first line of
`jbrep evaluate`; and, for each task, what was said of every code and what its agents returned.
"""

import csv
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.errors import InputError
from jbrep.evaluation.evaluation import EVALUATION, Evaluation
from jbrep.evaluation.table import headline
from jbrep.records.document import read_document
from jbrep.reporting.evaluation import AS_GOOD, judge
from jbrep.reporting.tables import Tables, read_tables
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.intervals import correlation_of_ranks, over_families
from jbrep.studies.tables import by_run
from jbrep.text import SIGNIFICANT, Table, interval, number

SCORES, LEARNED = "scores", "learned.csv"
REWARDED, REWARD, SIZE = "rewarded", "reward", "how many numbers"
SHORT, WHOLE = "a short run", "a whole run"
SHORT_STEPS = 50_000  # until the first evaluation after them: half a minute
PRIMARY, LEAST, LEAST_LOW = "trees", 0.8, 0.6  # the mean over tasks, and its interval's low end
APART = 0, 0.05, 0.1, 0.2  # differences in *rewarded*, from each to the next
Pairs = list[tuple[Array, Array]]  # what is said of each code, and what others' runs returned


class Scored(NamedTuple):
    """The codes of a task with what was known of them beforehand, and what they returned.

    Attributes:
        task: that the agents learned.
        codes: n of them.
        families: of the codes, (n,).
        pairs: for each run that is left out, by what ranks the codes.
        returns: the mean final return of each code, (n,).
        good: the recommended codes, by their evaluation.
        taken: the one to take.
    """

    task: str
    codes: list[str]
    families: list[str]
    pairs: Mapping[str, Pairs]
    returns: Array
    good: list[str]
    taken: str | None


def read(folder: Path) -> Scored:
    """What the tables of a study and the evaluation of its encoders say.

    Raises:
        InputError: agents trained on others than those that have scores; runs are missing; or as
            `read_tables`.
    """
    tables = read_tables(folder)
    evaluation = read_document(folder / SCORES / EVALUATION, Evaluation)
    check(evaluation, tables)
    labels = tables.raw.record.labels.values()
    kinds = {each.settings.representation: each.encoder.kind for each in labels}
    codes = [code for code in kinds if code != FULL]
    finals, short, whole = returned(tables, codes)
    others = (finals.sum(1, keepdims=True) - finals) / (finals.shape[1] - 1)
    pairs: dict[str, Pairs] = {
        name: [(np.array([score[code] for code in codes]), each) for each in others.T]
        for name, score in scores(evaluation, folder / SCORES / LEARNED).items()
    }
    for name, single in ((SHORT, short), (WHOLE, whole)):
        pairs[name] = [*zip(single.T, others.T, strict=True)]
    return Scored(
        task=evaluation.data.task,
        codes=codes,
        families=[kinds[code] for code in codes],
        pairs=pairs,
        returns=finals.mean(1),
        good=[*judge(evaluation).enough],
        taken=judge(evaluation).recommended,
    )


def scores(evaluation: Evaluation, path: Path) -> dict[str, dict[str, float]]:
    """What was known of every code before agents trained, by what found it out.

    Raises:
        InputError: something was learned from other encoders than those that were judged.
    """
    found = {
        name: {code: headline(e)[name] or 0.0 for code, e in evaluation.encoders.items()}
        for name in (REWARDED, REWARD)
    }
    found[SIZE] = {code: float(e.latent) for code, e in evaluation.encoders.items()}
    if path.exists():
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if row["sha256"] != evaluation.hashes.get(row["code"], ""):
                    raise InputError(f"{path}: {row['code']} is another code than the one judged")
                found.setdefault(row["way"], {})[row["code"]] = float(row["final"])
    return found


def returned(tables: Tables, codes: Sequence[str]) -> tuple[Array, Array, Array]:
    """Final returns, and means of a short run's and a whole run's evaluation, (codes, runs) each.

    Raises:
        InputError: runs are missing, or no run is longer than a short one.
    """
    analysis = tables.analysis
    if analysis is None or len(analysis.groups) != 1 or tables.raw.record.missing:
        raise InputError(f"{tables.name} lacks runs of one task: run the study to its end")
    (group,) = analysis.groups
    if not (later := [int(step) for step in group.grid if step >= SHORT_STEPS]):
        raise InputError(f"{tables.name} has runs of fewer than {SHORT_STEPS:,} steps")
    labels = {each.representation: each for each in group.labels}
    evaluated = by_run(tables.raw.returns)

    def means(step: int) -> Array:
        of_runs = [
            [
                evaluated.get((f"{group.task}/{group.algorithm}/{code}", seed), {}).get(step)
                for seed in labels[code].seeds
            ]
            for code in codes
        ]
        failed = [np.nan if group.failure_return is None else group.failure_return]
        return np.array([[np.mean(each or failed) for each in runs] for runs in of_runs])

    finals = np.stack([labels[code].by_run["final_return"] for code in codes])
    return finals, means(later[0]), means(later[-1])


def check(evaluation: Evaluation, tables: Tables) -> None:
    """Check that agents trained on the very encoders that have scores.

    Raises:
        InputError: on others.
    """
    for run in tables.raw.record.runs:
        code = tables.raw.record.labels[run.label].settings.representation
        if code != FULL and evaluation.hashes.get(code) != run.encoder:
            raise InputError(f"{run.label}: agents trained on another code than the one scored")


def mean_rank_correlation(pairs: Pairs, families: Sequence[str]) -> Interval:
    """The mean over tasks, or runs, of rank correlations, with its interval over families."""
    return over_families(lambda times: mean_of_ranks(pairs, times), families)


def difference(pairs: Pairs, others: Pairs, families: Sequence[str]) -> Interval:
    """How much the mean rank correlation of pairs is above that of others, on the same resamples.

    Both are of the same codes and tasks.
    """
    return over_families(
        lambda times: mean_of_ranks(pairs, times) - mean_of_ranks(others, times), families
    )


def mean_of_ranks(pairs: Pairs, times: Array) -> Array:
    """The mean correlation of ranks with each code so many times, (..., n); (...)."""
    return np.mean([correlation_of_ranks(x, y, times) for x, y in pairs], axis=0)


def apart(task: Scored) -> Iterator[str]:
    """How often, of two codes so far apart in *rewarded*, the one with more returned more."""
    said, _ = task.pairs[REWARDED][0]
    pairs = np.array([*combinations(range(len(task.codes)), 2)]).T
    more, returned = (values[pairs[0]] - values[pairs[1]] for values in (said, task.returns))
    for least, most in pairwise((*APART, np.inf)):
        within = (np.abs(more) >= least) & (np.abs(more) < most)
        agree = (more * returned > 0) & within
        yield f"{agree.sum()} of {within.sum()}"


def advised(task: Scored) -> tuple[str, ...]:
    """What the code to take returned, those recommended on average, those by *reward*, the best."""
    returns = dict(zip(task.codes, task.returns, strict=True))
    others = [code for code in task.codes if code not in task.good]
    reward, _ = task.pairs[REWARD][0]
    by_reward = [task.codes[i] for i in np.flatnonzero(reward >= AS_GOOD * reward.max())]
    told = (
        f"{len(codes)}: {np.mean([returns[code] for code in codes]):.0f}" if codes else "none"
        for codes in (task.good, others, by_reward)
    )
    best = max(returns, key=returns.__getitem__)
    taken = f"{task.taken} {returns[task.taken]:.0f}" if task.taken else "none"
    return task.task, taken, *told, f"{best} {returns[best]:.0f}"


def by_code(task: Scored) -> Table:
    """What was said of every code, beside the mean final return of its runs, the best first."""
    said = {name: np.mean([each for each, _ in pairs], 0) for name, pairs in task.pairs.items()}
    said["final return"] = task.returns
    cells = {name: [number(each, SIGNIFICANT) for each in values] for name, values in said.items()}
    order = np.argsort(-said["final return"], kind="stable")
    rows = [(task.codes[i], *(of_codes[i] for of_codes in cells.values())) for i in order]
    return Table(f"{task.task}: scores and mean returns", ("code", *cells), rows)


def verdict(mean: Interval, above_rewarded: Interval, above_short: Interval) -> str:
    """Whether what was hoped for is so."""
    holds = (
        mean.value >= LEAST
        and mean.low > LEAST_LOW
        and min(above_rewarded.low, above_short.low) > 0
    )
    return (
        f"Hoped for: by {PRIMARY} at least {LEAST} on average, above {LEAST_LOW} at the low end, "
        f"and clearly above both others: {'it is so' if holds else 'it is not so'}"
    )


def main(*folders: str) -> None:
    if not folders:
        raise SystemExit(__doc__)
    tasks = [read(Path(each)) for each in folders]
    first = tasks[0]
    for each in tasks:
        if each.codes != first.codes or each.pairs.keys() != first.pairs.keys():
            raise InputError(f"{each.task} has other codes or scores than {first.task}")

    def together(name: str) -> Pairs:
        return [pair for each in tasks for pair in each.pairs[name]]

    def cells(name: str) -> list[Interval]:
        alone = [mean_rank_correlation(each.pairs[name], first.families) for each in tasks]
        mean = mean_rank_correlation(together(name), first.families)
        rivals = [together(rival) for rival in (REWARDED, SHORT)]
        return [*alone, mean, *(difference(together(name), r, first.families) for r in rivals)]

    found = {name: cells(name) for name in first.pairs}
    rows = [(name, *(interval(each.tolist(), ".2f") for each in found[name])) for name in found]
    header = ("ranked by", *(each.task for each in tasks), "mean", f"above {REWARDED}")
    counts = f"{len(first.codes)} codes of {len({*first.families})} families"
    title = f"Rank correlations with mean final returns of all runs but one, {counts}"
    print(Table(title, (*header, f"above {SHORT}"), rows).text())
    if PRIMARY in found:
        print(f"\n{verdict(*found[PRIMARY][-3:])}")
    differences = [f"{least:g} to {most:g}" for least, most in pairwise(APART)]
    differences.append(f"{APART[-1]:g} or more")
    title = f"Of two codes, how often that with more {REWARDED} returned more, by their difference"
    print(f"\n{Table(title, ('task', *differences), [(e.task, *apart(e)) for e in tasks]).text()}")
    title = "Mean final returns of the code to take by jbrep evaluate, and of all recommended"
    by_reward = f"if by {REWARD}"
    header = ("task", "to take", "recommended", "the others", by_reward, "best of all")
    print(f"\n{Table(title, header, [advised(each) for each in tasks]).text()}")
    for each in tasks:
        print(f"\n{by_code(each).text()}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except InputError as error:
        sys.exit(f"Error: {error}")
