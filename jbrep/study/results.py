"""The runs of a study as tables, and what the statistics say of them."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.envs.task import Task
from jbrep.errors import InputError, listed
from jbrep.evaluate.table import DIAGNOSTICS
from jbrep.records.record import to_plain
from jbrep.records.storage import exists
from jbrep.records.tables import write_csv, write_rows
from jbrep.rl.files import (
    FAILED,
    RUN,
    RunRecord,
    read_evaluations,
    read_infos,
    read_run,
    runs_below,
)
from jbrep.stats import Analysis, RunCurve, analyse
from jbrep.stats.curves import common_grid
from jbrep.stats.runs import groups
from jbrep.stats.scale import BLIND, best_blind
from jbrep.study.plan import STUDY, Plan
from jbrep.study.record import RECORD, LabelSettings, RunFacts, RunsRecord, runs_record
from jbrep.study.tables import (
    REFERENCE_RETURNS,
    RETURNS,
    RUN_INFOS,
    References,
    Return,
    RunInfo,
    by_run,
    former_record,
    hash_of_references,
    read_references,
    table_hashes,
    write_references,
)
from jbrep.text import counted

Ended = dict[Path, RunRecord]  # what run.json says of each run that has ended, by folder


def write_tables(folder: Path) -> list[Path]:
    """Write the tables of the runs below a folder, of a study or not, as far as they have ended.

    Args:
        folder: with the runs.

    Returns:
        The files: every return, what was run, what `info` told, the returns of reference policies.
    """
    ended, before = _ended(folder), table_hashes(folder)
    references = hash_of_references(folder, before)
    rows, infos = list(_returns(ended)), list(_of_runs(ended, read_infos))
    tables = {name: before[name] for name in (DIAGNOSTICS,) if name in before}
    tables[RETURNS] = write_rows(folder / RETURNS, rows, Return)
    if infos:
        tables[RUN_INFOS] = write_csv(folder / RUN_INFOS, RunInfo._fields, infos)
    if references:
        tables[REFERENCE_RETURNS] = references
    runs_record(folder, ended, tables).write(folder / RECORD)  # last: it says what they are
    names = dict.fromkeys((RETURNS, RECORD, *tables))
    return [folder / name for name in names if name != DIAGNOSTICS]


def play_references(plan: Plan) -> None:
    """Play the policies that a study's runs are compared with, on the starts of their ends."""
    ended, former = map(read_run, runs_below(plan.folder)), former_record(plan.folder)
    before, played_on = (former.tables, former.tasks) if former else ({}, {})
    top = plan.study.verdicts.reference
    sha256 = write_references(_tasks(ended), plan.folder, before, played_on, top)
    if former and sha256 and before.get(REFERENCE_RETURNS) != sha256:
        former.replace(tables={**before, REFERENCE_RETURNS: sha256}).write(plan.folder / RECORD)


def found(
    record: RunsRecord,
    returns: Sequence[Return],
    references: References,
) -> tuple[Analysis | None, list[str]]:
    """The statistics of what the tables of a study say, if its runs allow any.

    Args:
        record: runs.json.
        returns: returns.csv.
        references: references.csv.

    Returns:
        The statistics, None where there are too few runs, or runs that can't be compared; and what
        there are none of, and why.
    """
    planned = replace(record.planned, prevented=_prevented(record, references))
    runs = _curves(record, returns, references)
    compared, left_out = _comparable(runs, planned.rules.baseline)
    compared, refused = _without_refused(compared, planned.rules.baseline)
    left_out += refused
    try:
        analysis = analyse(compared, planned, references=references) if compared else None
        return analysis, left_out
    except InputError as error:
        return None, [*left_out, str(error)]


def read_runs(folder: Path) -> list[RunCurve]:
    """The runs below a folder that have finished or failed."""
    ended = _ended(folder)
    references = read_references(folder, table_hashes(folder).get(REFERENCE_RETURNS))
    return _curves(runs_record(folder, ended, {}), _returns(ended), references)


def has_runs(folder: Path) -> bool:
    """Whether a run below a folder has ended, or it is of a study that has no tables yet."""
    return any(folder.rglob(RUN)) or (exists(folder / STUDY) and not exists(folder / RECORD))


def _ended(folder: Path) -> Ended:
    folders = runs_below(folder)
    if not folders:
        resumed = exists(folder / STUDY)
        what_to_do = (
            "jbrep study resumes it" if resumed else "train one with jbrep rl or jbrep study"
        )
        raise InputError(f"no finished run below {folder}: {what_to_do}")
    ended = {each: read_run(each) for each in folders}
    known: dict[tuple[str, int], Path] = {}
    for each, run in ended.items():
        other = known.setdefault((run.settings.label, run.settings.seed), each)
        if other != each:
            raise InputError(
                f"{other} and {each} are both seed {run.settings.seed} of {run.settings.label}: "
                "put runs that differ in anything else in folders of their own"
            )
    return ended


def _comparable(runs: list[RunCurve], baseline: str) -> tuple[list[RunCurve], list[str]]:
    """The runs that there can be statistics of, though others are missing; what is left out."""
    counts = Counter((run.task, run.algorithm, run.representation) for run in runs)
    alone = {
        key: f"{'/'.join(key)}: one run has ended, at least two are needed"
        for key, count in counts.items()
        if count == 1
    }
    alone |= {
        key: f"{'/'.join(key)}: at least two runs of {baseline} are needed to compare it with"
        for key in counts
        if counts[*key[:2], baseline] < 2 and key not in alone
    }
    kept = [run for run in runs if (run.task, run.algorithm, run.representation) not in alone]
    return kept, sorted(alone.values())


def _without_refused(runs: list[RunCurve], baseline: str) -> tuple[list[RunCurve], list[str]]:
    """The runs of tasks and algorithms that there can be statistics of; why not of the others."""
    by_group: dict[tuple[str, str], list[RunCurve]] = {}
    for run in runs:
        by_group.setdefault((run.task, run.algorithm), []).append(run)
    kept, refused = list[RunCurve](), []
    for some in by_group.values():
        try:
            for group in groups(some, baseline).values():
                common_grid(group)
            kept += some
        except InputError as error:
            refused.append(str(error))
    return kept, refused


def _tasks(runs: Iterable[RunRecord]) -> Iterable[tuple[Task, int]]:
    """The tasks of runs, with the most episodes that one was evaluated on at its end."""
    tasks: dict[str, tuple[Task, int]] = {}
    for run in runs:
        task, episodes = run.settings.environment, run.settings.final_episodes
        _, most = tasks.get(task.name, (task, 0))
        tasks[task.name] = task, max(most, episodes)
    return tasks.values()


def _returns(ended: Ended) -> Iterator[Return]:
    """A row for each episode of each evaluation, by label, seed and step."""
    return (Return(*row) for row in _of_runs(ended, read_evaluations))


def _of_runs(ended: Ended, read: Callable[[Path], Iterable[NamedTuple]]) -> Iterator[list[Any]]:
    """The rows of a table that runs have, each after what tells its run, by label and seed."""
    runs = ((run.settings, folder) for folder, run in ended.items())
    for settings, folder in sorted(runs, key=lambda run: (run[0].label, run[0].seed)):
        key = settings.task, settings.learner, settings.representation, settings.seed
        for row in read(folder):
            yield [*key, *row]


def _curves(
    record: RunsRecord, returns: Iterable[Return], references: References
) -> list[RunCurve]:
    """The runs of a study, from its tables."""
    evaluated, top = by_run(returns), record.planned.rules.top
    return [
        _curve(
            run,
            settings,
            record.draws_of(settings.learner),
            evaluated.get((run.label, run.seed), {}),
            references.get(settings.task, {}),
            top,
        )
        for run, settings in ((run, record.settings_of(run)) for run in record.runs)
    ]


def _prevented(record: RunsRecord, references: References) -> dict[str, str]:
    """Why there are no verdicts on tasks, by name, where what scores 0 or 1 isn't known."""
    named = record.planned.rules.reference
    needed = (*BLIND, named) if isinstance(named, str) and named else BLIND
    tasks = {record.settings_of(run).task for run in record.runs}
    unknown = {
        task: [policy for policy in needed if policy not in references.get(task, {})]
        for task in tasks
    }
    return {
        task: f"what {listed(policies)} would return isn't known, by which returns are scored: "
        "jbrep study plays them when it runs"
        for task, policies in unknown.items()
        if policies
    }


def _environment(task: Task) -> str:
    """What decides which returns there can be, as text for a message."""
    return ", ".join([task.id, *task.given_arguments, counted(task.max_episode_steps, "step")])


def _mean(returns: Sequence[float]) -> float | None:
    return float(np.mean(returns)) if len(returns) else None


def _curve(
    run: RunFacts,
    shared: LabelSettings,
    drawn: Collection[str],
    by_step: Mapping[int, list[float]],
    played: Mapping[str, Sequence[float]],
    top: str | float,
) -> RunCurve:
    """A run, from its settings without the seed and what that draws, and its returns by step.

    What was played, by policy, was so from the same starts. What scores 1 is one of these policies,
    or a return.
    """
    task, settings = shared.environment, to_plain(shared)
    if drawn:  # the overrides say the hyperparameters
        del settings["hyperparameters"]
        settings["overrides"] = {n: v for n, v in shared.overrides.items() if n not in drawn}
    del settings["device"]
    steps = sorted(by_step)
    returns = [by_step[step] for step in steps]
    episodes = min(map(len, returns), default=0)  # the last evaluation may have more
    if any(len(each) > episodes for each in returns[:-1]):
        raise InputError(f"run {run.label}, seed {run.seed}: evaluations differ in their episodes")
    blind = played.get(
        best_blind({n: float(np.mean(each)) for n, each in played.items()}) or "", ()
    )
    able = (top,) * shared.final_episodes if isinstance(top, float) else played.get(top, ())
    return RunCurve(
        task=task.name,
        algorithm=shared.learner,
        representation=shared.representation,
        seed=run.seed,
        settings=hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8],
        steps=np.array(steps, dtype=np.int64),
        returns=np.array([each[:episodes] for each in returns], float).reshape(
            -1, max(episodes, 1)
        ),
        total_steps=max(run.steps, shared.steps),
        failed_at=run.steps if run.status == FAILED else None,
        return_floor=task.return_floor,
        return_ceiling=task.return_ceiling,
        reference=_mean(blind[: shared.final_episodes]),
        reference_in_training=_mean(blind[:episodes]),
        top=_mean(able[: shared.final_episodes]),
        top_in_training=_mean(able[:episodes]),
        solved=task.solved_return,
        environment=_environment(task),
        final=np.array(returns[-1]) if returns and len(returns[-1]) > episodes else None,
        encoder_seed=run.encoder_seed,
    )
