"""jbrep from Python: what the commands do, as functions with the same words and defaults.

Each is there as `jbrep.NAME`; the commands call them. A task is the name of one, such as
face_direction or Hopper-v5, or what `jbrep.describe` returns; data are a `Dataset` or the folder of
one. What a function works with is imported when it is called.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jbrep.errors import InputError, Notice

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from jbrep.dataset import Dataset
    from jbrep.encoders import Encoder
    from jbrep.envs.task import Task
    from jbrep.evaluate.evaluation import Diagnostics, Evaluation
    from jbrep.methods.fit import Fitted, Fitter
    from jbrep.report.report import Report
    from jbrep.rl.controller import Controller
    from jbrep.rl.files import RunRecord
    from jbrep.rl.run_settings import RunSettings
    from jbrep.study import Study


class Agent(NamedTuple):
    """A run that has ended.

    Attributes:
        folder: of the run.
        record: what run.json says: settings, status, seconds.
        encoder: of the agent, if it is a user's own object.
    """

    folder: Path
    record: "RunRecord"
    encoder: Any = None

    @property
    def returns(self) -> "NDArray[np.float64]":
        """Returns of the final evaluation, one of each episode."""
        import numpy as np

        from jbrep.rl.files import last_returns, read_evaluations

        return np.array(last_returns(read_evaluations(self.folder)))

    @property
    def policy(self) -> "Controller":
        """What it has learned, as a function of observations."""
        from jbrep.rl.controller import load_policy

        return load_policy(self.folder, self.encoder)

    def __repr__(self) -> str:
        from jbrep.rl.files import FINISHED
        from jbrep.text import returns_text

        settings = self.record.settings
        what = f"{settings.learner} on {settings.representation}, {settings.task}"
        if self.record.status != FINISHED:
            return f"Agent({what}: {self.record.reason})"
        return f"Agent({what}: {returns_text(self.returns)}; {str(self.folder)!r})"

    def _repr_html_(self) -> str:
        from jbrep.rl.files import read_evaluations
        from jbrep.text import Table, html, interval_of

        returns: dict[int, list[float]] = {}
        for each in read_evaluations(self.folder):
            returns.setdefault(each.step, []).append(each.episode_return)
        rows = [(f"{step:,}", interval_of(own), str(len(own))) for step, own in returns.items()]
        header = ("steps", "return: median [10 %, 90 %]", "episodes")
        return html(repr(self), Table("", header, rows))


class Judged(NamedTuple):
    """What is known of encoders.

    Attributes:
        evaluation: all of it, as evaluation.json has it.
    """

    evaluation: "Evaluation"

    @property
    def encoders(self) -> "dict[str, Diagnostics]":
        """What is known of each, by what tables call it."""
        return self.evaluation.encoders

    def __repr__(self) -> str:
        from jbrep.report.evaluation import evaluation_text
        from jbrep.text import terminal_width

        return evaluation_text(self.evaluation, terminal_width())

    def _repr_html_(self) -> str:
        from jbrep.report.evaluation import evaluation_html

        return evaluation_html(self.evaluation)


def collect(
    task: "Task | str",
    out: str | Path,
    steps: int,
    *,
    policy: str = "uniform",
    seed: int = 0,
    store_state: bool = False,
    shard_episodes: int | None = None,
    lanes: int = 100,
    threads: int | None = None,
    retries: int = 0,
    backend: str = "local",
) -> "Dataset":
    """Collect the states that a policy visits, as `jbrep collect` does.

    Args:
        task: whose environment is played; how readings that are missing are treated belongs to it.
        out: a folder: new, or with an unfinished or smaller data set of the same settings.
        steps: how many; the last episode is completed.
        policy: uniform, heuristic, the folder of a run, or another that the command takes.
        seed: root of every episode's seed.
        store_state: store the Jitterbug's qpos and qvel, too.
        shard_episodes: episodes in a shard; None for shards of a usual size.
        lanes: environments that are stepped at once.
        threads: of a batch, or processes; None for as many as cores, 1 for a robot that exists
            once.
        retries: how often in a row an environment that fails is made anew and tried again.
        backend: local, or ray for a cluster.
    """
    from jbrep.collect.collector import collect as run
    from jbrep.collect.collector import usual_shard_episodes
    from jbrep.dataset import Dataset, DataSettings
    from jbrep.envs.description import as_task
    from jbrep.play.sources import find_policy

    folder, known = Path(out), as_task(task)
    if not known.reproducible:
        _note(
            f"{known.name} is not reproducible: no episode can be simulated again, to verify or to "
            "repair the data set"
        )
    actor = find_policy(policy, folder, known)
    settings = DataSettings(
        task=known, policy=actor.settings(), steps=steps, seed=seed, store_state=store_state
    )
    settings = settings.replace(
        shard_episodes=shard_episodes or usual_shard_episodes(settings, folder, actor, retries)
    )
    _tell_kept(folder, settings.policy)
    run(settings, folder, lanes, threads, backend, actor, retries)
    return Dataset(folder)


def train_encoder(
    data: "Dataset | str | Path",
    out: str | Path,
    kind: str = "dae",
    *,
    name: str | None = None,
    preset: str | None = None,
    device: str = "auto",
    **settings: Any,
) -> "Encoder":
    """Make an encoder from a data set, as `jbrep train-encoder` does.

    Args:
        data: 80 % of its episodes are learned from.
        out: a folder for the encoder's file; a training that was stopped goes on from there.
        kind: dae, pca, slow, ...; the command lists them.
        name: of the encoder and its file; None for what it is, such as dae-8.
        preset: named settings; of dae: authors, its authors' own.
        device: cpu, cuda or auto.
        settings: of the kind, such as latent=8 or on="symmetry".
    """
    from jbrep.methods.registry import with_preset

    settings = with_preset(kind, preset, settings)
    return _fitter(data, out, device).fit(kind, name=name, **settings).encoder


def train_encoders(
    data: "Dataset | str | Path",
    out: str | Path,
    kind: str = "dae",
    *,
    latent: Sequence[int | str] = (),
    seeds: int | None = None,
    name: str | None = None,
    preset: str | None = None,
    device: str = "auto",
    **settings: Any,
) -> "Iterator[Fitted]":
    """Make several encoders of a kind, one of each latent size and seed.

    All settings are checked at once; an encoder is made when the next one is asked for:

        for made in jbrep.train_encoders("data/face", "encoders", "dae", latent=[12, 8, 4]):
            print(made)

    Args:
        data: as for `train_encoder`.
        out: a folder for all of them.
        kind: of all of them.
        latent: sizes; empty for a kind that has none.
        seeds: n for one of each of the seeds 0 to n - 1, as NAME-s0; None for the usual one.
        name: of one latent size; None for what they are.
        preset: named settings.
        device: cpu, cuda or auto.
        settings: of the kind, for all of them.
    """
    from jbrep.methods.registry import each_named, with_preset

    named = each_named(kind, latent, seeds, name, with_preset(kind, preset, settings))
    fitter = _fitter(data, out, device)
    for called, each in named:  # every mistake is reported before the first training
        fitter.plan(kind, name=called, **each)
    return (fitter.fit(kind, name=called, **each) for called, each in named)


def evaluate(
    encoders: Mapping[str, Any] | Sequence[Any] | Any,
    data: "Dataset | str | Path",
    out: str | Path | None = None,
    *,
    policy: str | None = None,
    truth: "Dataset | str | Path | None" = None,
) -> Judged:
    """Judge encoders on the held-out part of a data set, as `jbrep evaluate` does.

    Args:
        encoders: one, several, or several by names of yours: files, names of shipped ones, torch
            modules, functions.
        data: that they are judged on.
        out: a folder for evaluation.json; None to write nothing.
        policy: that does the task well; None for the task's hand-written one, if there is one.
        truth: the data set that `data` was derived from, with what it hides.
    """
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.encoders.shipped import find_all
    from jbrep.evaluate.evaluation import EVALUATION
    from jbrep.records.storage import make_folder

    scaled = ScaledDataset.of(data)
    whole = Dataset(truth) if isinstance(truth, str | Path) else truth
    if whole is not None:
        from jbrep.evaluate.held_out import hidden_of

        hidden_of(scaled.dataset, whole)
    if out is not None:
        make_folder(Path(out), (EVALUATION,))
    from jbrep.evaluate.diagnosis import diagnose, write  # imports torch
    from jbrep.play.sources import find_good_policy

    own_rewards = bool(scaled.dataset.manifest.settings.reward)
    found = find_all(encoders, scaled.task)
    good = find_good_policy(policy, scaled.task, own_rewards)
    if out is None:
        return Judged(diagnose(found, scaled, good, whole))
    return Judged(write(found, scaled, Path(out), good, whole))


def train(
    task: "Task | str",
    out: str | Path,
    *,
    algorithm: str = "sac",
    preset: str = "",
    encoder: Any = "full",
    seed: int = 0,
    overrides: Mapping[str, Any] = {},
    threads: int | None = None,
    retries: int = 0,
    wandb: str | None = None,
    stop: Callable[[], bool] = lambda: False,
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
        threads: of a batch; None for as many as cores, 1 for a robot that exists once.
        retries: how often in a row an environment that fails is made anew and tried again.
        wandb: a project of Weights & Biases to log to, too.
        stop: asked before each rollout; once it is true, the run writes a checkpoint and stops.
        settings: of the training: steps, evaluate_every, evaluation_episodes, ...

    Raises:
        StoppedError: `stop` was true.
    """
    from jbrep.envs.description import as_task
    from jbrep.envs.make import is_one_robot
    from jbrep.machine import cores
    from jbrep.rl.history import Bar
    from jbrep.rl.run import Run
    from jbrep.rl.settings import MODERN
    from jbrep.rl.training import Session, standing_of
    from jbrep.rl.training import train as train_run

    known = as_task(task)
    if one_robot := is_one_robot(known, threads):
        preset, settings = preset or MODERN, {**settings, "one_robot": True}
    run = Run.of(known, algorithm, preset, overrides, encoder=encoder, seed=seed, **settings)
    if one_robot and run.learner.hyperparameters.num_envs > 1:
        run = run.replace(learner=run.learner.overridden({"num_envs": 1}))
    folder, found = Path(out), run.find_encoder()
    now = standing_of(run, folder, found)
    if now.ended:
        _note(f"the run in {folder} had {now.ended.status} already: nothing was done")
    else:
        _note_limits(now.settings)
    writers = []
    if wandb:
        from jbrep.rl.history import Tracker

        writers.append(Tracker(wandb, folder, now.settings))
    with closing(Bar(run.steps, f"{algorithm} on {found.name}")) as bar:
        session = Session(
            bar.show,
            stop=stop,
            writers=writers,
            keep_checkpoint=True,
            threads=threads or cores(),
            retries=retries,
        )
        record = train_run(run, folder, session, found)
    return Agent(folder, record, None if isinstance(encoder, str | Path) else encoder)


def study(
    study: "Study | Mapping[str, Any] | str | Path",
    out: str | Path,
    *,
    workers: int | None = None,
    backend: str = "local",
) -> "Report":
    """Train a grid of agents, and report what became of them, as `jbrep study` does.

    Args:
        study: a `Study`, what its file would hold as a dictionary, or the file.
        out: a folder; one that was stopped goes on.
        workers: processes at a time; None for one for each core.
        backend: local, or ray for a cluster.
    """
    from jbrep.errors import choose
    from jbrep.study import Plan, run_study
    from jbrep.study.runner import BACKENDS
    from jbrep.text import counted

    file = Path(study) if isinstance(study, str | Path) else None
    plan, run = Plan(_study(study), Path(out), file), choose(backend, BACKENDS, "backend")
    for notice in plan.study.notices:
        _note(notice)
    if crashed := run_study(plan, run, workers):
        _note(f"{counted(crashed, 'run')} crashed: the same study in that folder tries again")
    return report(plan.folder)


def report(
    folder: str | Path,
    *,
    evaluation: Sequence[str] = (),
    out: str | Path | None = None,
) -> "Report":
    """Show what a study found, as `jbrep report` does.

    Args:
        folder: of a study, of runs, or of the tables of a study.
        evaluation: folders of evaluations of its encoders, whose diagnostics go into the tables.
        out: a folder for the report; None for the study's own.
    """
    from jbrep.records.storage import exists, make_folder

    if not exists(folder):
        raise InputError(f"{folder} is not the folder of a study: there is no such folder")
    if out:
        make_folder(Path(out))
    from jbrep.report.report import make_report  # imports torch

    return make_report(Path(folder), Path(out) if out else None, evaluation)


def _fitter(data: "Dataset | str | Path", out: str | Path, device: str) -> "Fitter":
    from jbrep.dataset import ScaledDataset
    from jbrep.methods.fit import Fitter

    scaled = ScaledDataset.of(data)
    for constant in scaled.constant_features:
        _note(f"{constant} is constant in the training part")
    return Fitter(scaled, Path(out), device)


def _study(given: "Study | Mapping[str, Any] | str | Path") -> "Study":
    from jbrep.study import Study, read_study
    from jbrep.study.config import as_study

    if isinstance(given, Study):
        return given
    return as_study(given) if isinstance(given, Mapping) else read_study(Path(given))


def _tell_kept(folder: Path, policy: Mapping[str, Any]) -> None:
    """Say which policies of runs the data set has already, as they were then."""
    from jbrep.dataset.settings import TRAINED, parts_of
    from jbrep.records.storage import exists

    for part in parts_of(policy):
        if part["kind"] == TRAINED and exists(folder / part["file"]):
            known = f"{part['run']} acts as it did at step {part['step']:,}"
            _note(f"{known}, which {folder / part['file']} keeps")


def _note_limits(settings: "RunSettings") -> None:
    """Say of a run what can't come of it."""
    if settings.steps <= settings.learns_from:
        _note(
            f"{settings.learner} learns from step {settings.learns_from:,} on: "
            f"{settings.steps:,} steps leave the policy as it was drawn; take more, or another "
            "preset"
        )
    if not settings.environment.reproducible:
        _note(
            f"{settings.task} is not reproducible: the same seed gives other numbers the next "
            "time, and a run that is stopped can't be resumed; the policy of its last checkpoint "
            "can be played and exported"
        )


def _note(line: str) -> None:
    warnings.warn(line, Notice, stacklevel=3)
