"""The tables of a study: its runs, their returns, what policies return.

runs.json says what was run and has the SHA-256 of the others, so it is written after them.
"""

import hashlib
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError, Notice
from jbrep.play.references import play, policies_of
from jbrep.records.document import read_document
from jbrep.records.record import to_plain
from jbrep.records.storage import exclusive, exists
from jbrep.records.tables import read_rows, write_csv, write_rows
from jbrep.rl import files
from jbrep.stats.runs import RunCurve
from jbrep.stats.scale import best_blind
from jbrep.studies.plan import STUDY
from jbrep.studies.record import RECORD, RunFacts, RunsRecord
from jbrep.text import counted

RETURNS = "returns.csv"
REFERENCE_RETURNS = "references.csv"
RUN_INFOS = "run-infos.csv"  # a run may be in the same folder: its own table is infos.csv
_MOST_SECONDS = 600.0  # to wait for another process's tables

References = dict[str, dict[str, list[float]]]  # returns by task and policy


class Return(NamedTuple):
    """A row of returns.csv: an episode of an evaluation."""

    task: str
    algorithm: str
    representation: str
    seed: int
    step: int
    episode: int
    episode_return: float


class RunInfo(NamedTuple):
    """A row of run-infos.csv: a number that the environment told of such an episode."""

    task: str
    algorithm: str
    representation: str
    seed: int
    step: int
    episode: int
    name: str
    value: float


class _Reference(NamedTuple):
    """A row of references.csv: an episode of a reference policy."""

    task: str
    policy: str
    episode: int
    episode_return: float


def run_of(row: Return | RunInfo) -> tuple[str, int]:
    """The label and the seed of a row's run."""
    return f"{row.task}/{row.algorithm}/{row.representation}", row.seed


def by_run(returns: Iterable[Return]) -> dict[tuple[str, int], dict[int, list[float]]]:
    """The returns of each run's evaluations, by the run's label and seed, then by step."""
    found: dict[tuple[str, int], dict[int, list[float]]] = {}
    for row in returns:
        by_step = found.setdefault(run_of(row), {})
        by_step.setdefault(row.step, []).append(row.episode_return)
    return found


class Tables(NamedTuple):
    """All tables of a study."""

    record: RunsRecord
    returns: list[Return]
    infos: list[RunInfo]
    references: References

    def curves(self) -> tuple[list[RunCurve], list[str]]:
        """The returns of each run over training, and what they are held against; what can't be."""
        evaluated, found, refused = by_run(self.returns), list[RunCurve](), list[str]()
        for run in self.record.runs:
            try:
                found.append(_curve(self, run, evaluated.get((run.label, run.seed), {})))
            except DamageError:
                raise
            except InputError as error:  # such as a policy that was cloned, without a curve
                refused.append(str(error))
        return found, refused


def has_runs(folder: Path) -> bool:
    """Whether a run below a folder has ended, or it is of a study that has no tables yet."""
    return any(folder.rglob(files.RUN)) or (exists(folder / STUDY) and not exists(folder / RECORD))


def check_tables(folder: Path) -> None:
    """Make sure that a folder has the tables of a study."""
    if not exists(folder / RECORD):
        if any(folder.rglob(files.ENCODER)):
            raise InputError(f"no run in {folder} has ended yet: report them then")
        raise InputError(
            f"{folder} is not the folder of a study: it has neither runs nor a {RECORD}"
        )


def read_tables(folder: Path) -> Tables:
    """The tables in a folder.

    Raises:
        DamageError: one isn't what was written.
    """
    check_tables(folder)
    record = read_document(folder / RECORD, RunsRecord)
    known = record.tables
    infos = read_rows(folder / RUN_INFOS, RunInfo, known[RUN_INFOS]) if RUN_INFOS in known else []
    return Tables(
        record,
        read_rows(folder / RETURNS, Return, known.get(RETURNS, "")),
        infos,
        _references(folder, known),
    )


def _references(folder: Path, known: Mapping[str, str]) -> References:
    """The returns of reference policies, if runs.json knows the table."""
    found: References = {}
    if REFERENCE_RETURNS in known:
        path = folder / REFERENCE_RETURNS
        for row in read_rows(path, _Reference, known[REFERENCE_RETURNS]):
            found.setdefault(row.task, {}).setdefault(row.policy, []).append(row.episode_return)
    return found


def writing(folder: Path) -> AbstractContextManager[None]:
    """Be the only writer of the tables in a folder; another process is waited for."""
    return exclusive(folder / RECORD, beside=True, wait=_MOST_SECONDS)


def write_tables(folder: Path) -> None:
    """Write the tables of the runs below a folder, of a study or not, as far as they have ended.

    Within `writing`.
    """
    ended = _ended(folder)
    returns, infos = _of_runs(ended, files.read_evaluations), [*_of_runs(ended, files.read_infos)]
    record = RunsRecord.of(folder, ended)
    tables = dict(_lasting(folder, record.tasks))
    tables[RETURNS] = write_rows(folder / RETURNS, (Return(*row) for row in returns), Return)
    if infos:
        tables[RUN_INFOS] = write_csv(folder / RUN_INFOS, RunInfo._fields, infos)
    record.replace(tables=tables).write(folder / RECORD)


def _lasting(folder: Path, tasks: Mapping[str, Task]) -> Iterator[tuple[str, str]]:
    """The hashes of tables that aren't made from runs; of policies, if tasks are the same."""
    try:
        former = read_document(folder / RECORD, RunsRecord)
    except InputError:  # it is missing or damaged: it is written anew
        return
    alike = all(tasks.get(name, task) == task for name, task in former.tasks.items())
    of_runs = (RETURNS, RUN_INFOS, *([] if alike else [REFERENCE_RETURNS]))
    for name, sha256 in former.tables.items():
        if name not in of_runs and exists(folder / name):
            yield name, sha256


def _ended(folder: Path) -> dict[Path, files.RunRecord]:
    """The runs that have ended, by folder."""
    folders = files.runs_below(folder)
    if not folders:
        resumed = exists(folder / STUDY)
        what_to_do = (
            "jbrep study resumes it" if resumed else "train one with jbrep rl or jbrep study"
        )
        raise InputError(f"no finished run below {folder}: {what_to_do}")
    ended = {each: files.read_run(each) for each in folders}
    known: dict[tuple[str, int], Path] = {}
    for each, run in ended.items():
        other = known.setdefault((run.settings.label, run.settings.seed), each)
        if other != each:
            raise InputError(
                f"{other} and {each} are both seed {run.settings.seed} of {run.settings.label}: "
                "put runs that differ in anything else in folders of their own"
            )
    return ended


def _of_runs(
    ended: Mapping[Path, files.RunRecord], read: Callable[[Path], Iterable[NamedTuple]]
) -> Iterator[list[Any]]:
    """The rows of a table that runs have, each after what tells its run, by label and seed."""
    runs = ((run.settings, folder) for folder, run in ended.items())
    for settings, folder in sorted(runs, key=lambda run: (run[0].label, run[0].seed)):
        key = settings.task, settings.learner, settings.representation, settings.seed
        for row in read(folder):
            yield [*key, *row]


def play_references(folder: Path) -> None:
    """Play the policies that runs are compared with, on the starts of their ends.

    What the table has already isn't played again; what can't be played stays in it.

    Raises:
        DamageError: the table isn't what was written, and can't be played here.
    """
    record, damage = read_document(folder / RECORD, RunsRecord), None
    try:
        there = _references(folder, record.tables)
    except DamageError as error:
        there, damage = {}, error
    named = record.study.verdicts.policy if record.study else ""
    further, episodes = [named] if named else [], dict[str, int]()
    for label in record.labels.values():
        own = label.settings
        episodes[own.task] = max(episodes.get(own.task, 0), own.final_episodes)
    rows = list[_Reference]()
    for name, task in sorted(record.tasks.items()):
        for policy in dict.fromkeys((*policies_of(task), *further)):
            played = there.get(name, {}).get(policy, [])
            if len(played) != episodes[name]:
                try:
                    played = play(policy, task, episodes[name])
                except Exception as error:  # what has been trained is reported all the same
                    problem = f"policy {policy!r} couldn't be played on {name}: {error}"
                    warnings.warn(problem, Notice, stacklevel=2)
            if damage and not played:
                raise damage
            rows += (_Reference(name, policy, i, each) for i, each in enumerate(played))
    if not rows:
        return
    with writing(folder):
        path = folder / REFERENCE_RETURNS
        sha256 = write_csv(path, ("task", "policy", "episode", "return"), rows)
        record = read_document(folder / RECORD, RunsRecord)  # a report may have written meanwhile
        record.with_table(REFERENCE_RETURNS, sha256).write(folder / RECORD)


def _curve(tables: Tables, run: RunFacts, by_step: Mapping[int, list[float]]) -> RunCurve:
    """A run, from its settings without the seed and what that draws, and its returns by step."""
    record = tables.record
    shared, top = record.settings_of(run), record.planned.rules.top
    task, settings, drawn = shared.environment, to_plain(shared), record.draws_of(shared.learner)
    played = tables.references.get(shared.task, {})  # from the same starts
    if drawn:  # the overrides say the hyperparameters
        del settings["hyperparameters"]
        settings["overrides"] = {n: v for n, v in shared.overrides.items() if n not in drawn}
    del settings["device"]
    steps = sorted(by_step)
    returns = [by_step[step] for step in steps]
    episodes = min(map(len, returns), default=0)  # the last evaluation may have more
    if any(len(each) > episodes for each in returns[:-1]):
        raise DamageError(f"run {run.label}, seed {run.seed}: evaluations differ in their episodes")
    means = {policy: float(np.mean(each)) for policy, each in played.items()}
    blind = played.get(best_blind(means) or "", ())
    environment = [task.id, *task.given_arguments, counted(task.max_episode_steps, "step")]
    environment += [f"domain {task.domain}"] if task.domain else []
    able = (top,) * shared.final_episodes if isinstance(top, float) else played.get(top, ())
    return RunCurve(
        task=task.name,
        algorithm=shared.learner,
        representation=shared.representation,
        seed=run.seed,
        settings=_hash(settings),
        learner=_hash([settings.get(n) for n in ("preset", "overrides", "hyperparameters")]),
        steps=np.array(steps, dtype=np.int64),
        returns=np.array([each[:episodes] for each in returns], float).reshape(
            -1, max(episodes, 1)
        ),
        total_steps=max(run.steps, shared.steps),
        failed_at=run.steps if run.status == files.FAILED else None,
        return_floor=task.return_floor,
        return_ceiling=task.return_ceiling,
        reference=_mean(blind[: shared.final_episodes]),
        reference_in_training=_mean(blind[:episodes]),
        top=_mean(able[: shared.final_episodes]),
        top_in_training=_mean(able[:episodes]),
        solved=task.solved_return,
        environment=", ".join(environment),
        final=np.array(returns[-1]) if returns and len(returns[-1]) > episodes else None,
        encoder_seed=run.encoder_seed,
    )


def _hash(settings: Any) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def _mean(returns: Sequence[float]) -> float | None:
    return float(np.mean(returns)) if len(returns) else None
