"""jbrep from Python: what the commands do, as functions with the same words and defaults.

Each is there as `jbrep.NAME`. A task is the name of one, such as face_direction or Hopper-v5, or
what `jbrep.describe` returns; data are a `Dataset` or the folder of one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.collector import collect as write_data
from jbrep.collect.collector import usual_shard_episodes
from jbrep.collect.shards import LANES
from jbrep.dataset import Dataset, DataSettings, ScaledDataset
from jbrep.encoders import Encoder
from jbrep.encoders.file import SUFFIX
from jbrep.envs.description import as_task
from jbrep.envs.task import Task
from jbrep.errors import InputError, choose
from jbrep.evaluate.diagnosis import diagnose, write
from jbrep.evaluate.evaluation import Evaluation
from jbrep.methods.fit import Fitter
from jbrep.play.sources import find_good_policy, find_policy
from jbrep.report.report import PAGE, make_report
from jbrep.report.statistics import results_text
from jbrep.report.tables import Tables
from jbrep.rl import Run
from jbrep.rl.controller import Controller, load_policy
from jbrep.rl.files import FINISHED, RunRecord, last_returns, read_evaluations
from jbrep.rl.trainers import train as train_run
from jbrep.study import Plan, Study, read_study, run_study
from jbrep.study.config import as_study
from jbrep.study.runner import BACKENDS
from jbrep.study.tables import Return
from jbrep.text import interval_of, terminal_width

__all__ = [
    "Agent",
    "Report",
    "collect",
    "evaluate",
    "report",
    "study",
    "train",
    "train_encoder",
]


class Agent(NamedTuple):
    """A run that has ended.

    Attributes:
        folder: of the run.
        record: what run.json says: settings, status, seconds.
    """

    folder: Path
    record: RunRecord

    @property
    def returns(self) -> NDArray[np.float64]:
        """Returns of the final evaluation, one of each episode."""
        return np.array(last_returns(read_evaluations(self.folder)))

    @property
    def policy(self) -> Controller:
        """What it has learned, as a function of observations."""
        return load_policy(self.folder)

    def __repr__(self) -> str:
        settings = self.record.settings
        what = f"{settings.learner} on {settings.representation}, {settings.task}"
        if self.record.status != FINISHED:
            return f"Agent({what}: {self.record.reason})"
        count = len(self.returns)
        return (
            f"Agent({what}: {interval_of(self.returns)}, median [10 %, 90 %] of {count} episodes; "
            f"{str(self.folder)!r})"
        )


class Report(NamedTuple):
    """What a study found.

    Attributes:
        folder: that has the page, the tables and the figures.
        tables: what these say.
        notes: what the diagnostics that were given are missing.
    """

    folder: Path
    tables: Tables
    notes: tuple[str, ...] = ()

    @property
    def page(self) -> Path:
        """For a browser."""
        return self.folder / PAGE

    @property
    def returns(self) -> list[Return]:
        """The return of every episode of every evaluation: rows for a data frame."""
        return self.tables.returns

    def __repr__(self) -> str:
        return f"{results_text(self.tables, terminal_width())}\n\n{self.page}"


def collect(
    task: Task | str,
    out: str | Path,
    steps: int,
    *,
    policy: str = "uniform",
    seed: int = 0,
    store_state: bool = False,
    shard_episodes: int | None = None,
    lanes: int = LANES,
    threads: int | None = None,
    backend: str = "local",
) -> Dataset:
    """Collect the states that a policy visits, as `jbrep collect` does.

    Args:
        task: whose environment is played.
        out: a folder: new, or with an unfinished or smaller data set of the same settings.
        steps: how many; the last episode is completed.
        policy: uniform, heuristic, the folder of a run, or another that the command takes.
        seed: root of every episode's seed.
        store_state: store the Jitterbug's qpos and qvel, too.
        shard_episodes: episodes in a shard; None for shards of a usual size.
        lanes: environments that are stepped at once.
        threads: of a batch, or processes; None for as many as cores.
        backend: local, or ray for a cluster.

    Raises:
        InputError: as `jbrep.collect.collector.collect`.
    """
    folder, known = Path(out), as_task(task)
    actor = find_policy(policy, folder, known)
    settings = DataSettings(
        task=known, policy=actor.settings(), steps=steps, seed=seed, store_state=store_state
    )
    settings = settings.replace(
        shard_episodes=shard_episodes or usual_shard_episodes(settings, folder, actor)
    )
    write_data(settings, folder, lanes, threads, backend, actor)
    return Dataset(folder)


def train_encoder(
    data: Dataset | str | Path,
    out: str | Path,
    kind: str = "dae",
    *,
    name: str | None = None,
    device: str = "auto",
    **settings: Any,
) -> Encoder:
    """Make an encoder from a data set, as `jbrep train-encoder` does.

    Args:
        data: 80 % of its episodes are learned from.
        out: a folder for the encoder's file; a training that was stopped goes on from there.
        kind: dae, pca, slow, ...; the command lists them.
        name: of the encoder and its file; None for what it is, such as dae-8.
        device: cpu, cuda or auto.
        settings: of the kind, such as latent=8 or on="symmetry".

    Raises:
        InputError: a setting that the kind doesn't take, or one that is missing; or the file
            that it would have is another encoder's.
    """
    fitter = Fitter(_scaled(data), Path(out), device)
    return fitter.fit(kind, name=name, **settings).encoder


def evaluate(
    encoders: Mapping[str, Any] | Sequence[Any] | Any,
    data: Dataset | str | Path,
    out: str | Path | None = None,
    *,
    policy: str | None = None,
) -> Evaluation:
    """Judge encoders on the held-out part of a data set, as `jbrep evaluate` does.

    Args:
        encoders: one, several, or several by names of yours: files, names of shipped ones, torch
            modules, functions.
        data: that they are judged on.
        out: a folder for evaluation.json; None to write nothing.
        policy: that does the task well; None for the task's hand-written one, if there is one.

    Raises:
        InputError: an encoder that isn't one of this task's, or two of one name.
    """
    scaled = _scaled(data)
    labelled, good = _labelled(encoders), find_good_policy(policy, scaled.task)
    return (
        diagnose(labelled, scaled, good)
        if out is None
        else write(labelled, scaled, Path(out), good)
    )


def train(
    task: Task | str,
    out: str | Path,
    *,
    algorithm: str = "sac",
    preset: str = "",
    encoder: Any = "full",
    seed: int = 0,
    overrides: Mapping[str, Any] = {},
    **settings: Any,
) -> Agent:
    """Train and evaluate one agent, as `jbrep rl` does.

    Args:
        task: that it learns.
        out: a folder for the run; one that was stopped goes on from its checkpoint.
        algorithm: sac, td3, ddpg, ppo, ...
        preset: its settings: paper, modern, wide, or a TOML file; empty for wide, or modern where
            that has none.
        encoder: what it observes: full, a shipped encoder's name, a file, or an encoder of yours.
        seed: of agent and episodes.
        overrides: settings other than the preset's, such as {"learning_rate": 3e-4}.
        settings: of the training: steps, evaluate_every, evaluation_episodes, ...

    Raises:
        InputError: an unknown name, or a value that can't be used; or another run is in the folder.
    """
    run = Run.of(task, algorithm, preset, overrides, encoder=encoder, seed=seed, **settings)
    folder = Path(out)
    return Agent(folder, train_run(run, folder))


def study(
    study: Study | Mapping[str, Any] | str | Path,
    out: str | Path,
    *,
    workers: int | None = None,
    width: int | None = None,
    backend: str = "local",
) -> Report:
    """Train a grid of agents, and report what became of them, as `jbrep study` does.

    Args:
        study: a `Study`, what its file would hold as a dictionary, or the file.
        out: a folder; one that was stopped goes on.
        workers: processes at a time; None for one for each core.
        width: the most agents that learn together in a process; None for what keeps all busy.
        backend: local, or ray for a cluster.

    Raises:
        InputError: a study that can't be run, or the folder holds another.
    """
    plan = Plan(_study(study), Path(out))
    run_study(plan, choose(backend, BACKENDS, "backend"), workers, width)
    return report(plan.folder)


def report(
    folder: str | Path,
    *,
    evaluation: Sequence[str] = (),
    across_trainers: bool = False,
    out: str | Path | None = None,
) -> Report:
    """Show what a study found, as `jbrep report` does.

    Args:
        folder: of a study, of runs, or of the tables of a study.
        evaluation: folders of evaluations of its encoders, whose diagnostics go into the tables.
        across_trainers: compare runs of different trainers, too.
        out: a folder for the report; None for the study's own.

    Raises:
        InputError: there is nothing of a study, or a file is damaged.
    """
    target = Path(out or folder)
    made = make_report(Path(folder), target, evaluation, across_trainers)
    return Report(target, made.tables, tuple(made.lines))


def _study(given: Study | Mapping[str, Any] | str | Path) -> Study:
    if isinstance(given, Study):
        return given
    return as_study(given) if isinstance(given, Mapping) else read_study(Path(given))


def _scaled(data: Dataset | str | Path) -> ScaledDataset:
    return ScaledDataset(data if isinstance(data, Dataset) else Dataset(data))


def _labelled(encoders: Any) -> dict[str, Any]:
    """Encoders by the names that tables call them."""
    if isinstance(encoders, Mapping):
        return dict(encoders)
    several = encoders if isinstance(encoders, (list, tuple)) else [encoders]
    labels = [_label(each) for each in several]
    if twice := {label for label in labels if labels.count(label) > 1}:
        raise InputError(f"{min(twice)} is given twice: give encoders as a dictionary, by names")
    return dict(zip(labels, several, strict=True))


def _label(encoder: Any) -> str:
    if isinstance(encoder, (str, Path)):
        return Path(encoder).name.removesuffix(SUFFIX)
    return str(getattr(encoder, "name", type(encoder).__name__))
