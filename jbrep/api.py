"""jbrep from Python: what the commands do, as functions; the commands are read off them.

Each is there as `jbrep.NAME`. A task is the name of one, such as face_direction or Hopper-v5, or
what `jbrep.describe` returns; data are a `Dataset` or the folder of one. What a function works with
is imported when it is called. A `parameter` of which a docstring speaks is an option of the
command, too: see `jbrep.cli.generator`.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec import Meta

from jbrep.dataset.settings import RootSeed, ShardEpisodes, Steps, StoreState
from jbrep.errors import InputError, Notice, choose
from jbrep.parameters import (
    NOTHING,
    Acting,
    Algorithm,
    Backend,
    Episodes,
    GivenDrawnTask,
    GivenTask,
    Normalize,
    NumEnvs,
    Observed,
    OptionalGivenTask,
    Overrides,
    Preset,
    Retries,
    Threads,
    Workers,
    find_study,
)
from jbrep.records.keys import checked
from jbrep.rl.settings import CloneSettings, Seed, TrainingSettings
from jbrep.rl.settings import Steps as TrainingSteps

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from jbrep.checking.check import Check
    from jbrep.cloning.clone import CloneRecord
    from jbrep.dataset import Dataset
    from jbrep.encoders import Encoder
    from jbrep.envs.task import Task
    from jbrep.evaluation.evaluation import Diagnostics, Evaluation
    from jbrep.methods.fit import Fitted, Fitter
    from jbrep.reporting.report import Report
    from jbrep.rl.controller import Controller
    from jbrep.rl.files import RunRecord
    from jbrep.rl.run_settings import RunSettings
    from jbrep.studies import Study


class Agent(NamedTuple):
    """A run that has ended.

    Attributes:
        folder: of the run.
        record: what run.json says: settings, status, seconds.
        encoder: of the agent, if it is a user's own object.
        clone: if it was learned from data: held-out errors, and the returns of data and policy.
    """

    folder: Path
    record: "RunRecord"
    encoder: Any = None
    clone: "CloneRecord | None" = None

    @property
    def returns(self) -> "NDArray[np.float64]":
        """Returns of the final evaluation, one of each episode; none without an environment."""
        import numpy as np

        from jbrep.rl.files import last_returns, read_evaluations

        return np.array(last_returns(read_evaluations(self.folder)))

    @property
    def policy(self) -> "Controller":
        """What it has learned, as a function of observations."""
        from jbrep.rl.controller import load_policy

        return load_policy(self.folder, self.encoder)

    def __repr__(self) -> str:
        from jbrep.play.references import mean_text
        from jbrep.rl.files import FINISHED

        settings = self.record.settings
        what = f"{settings.learner} on {settings.representation}, {settings.task}"
        if self.record.status != FINISHED:
            return f"Agent({what}: {self.record.reason})"
        result = "not played"
        if len(self.returns):
            result = mean_text(settings.environment, self.returns)
        return f"Agent({what}: {result}; {str(self.folder)!r})"


class Evaluated(NamedTuple):
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
        from jbrep.reporting.evaluation import evaluation_text
        from jbrep.text import terminal_width

        return evaluation_text(self.evaluation, terminal_width())


@checked
def check(
    task: OptionalGivenTask = None,
    /,
    *,
    data: "Annotated[Dataset | str | Path | None, Meta(extra={'metavar': 'FOLDER'})]" = None,
    steps: Annotated[int, Meta(ge=500, le=1_000_000)] = 44_000,
    seed: Annotated[int, Meta(ge=0, le=1_000_000)] = 0,
    write: Path | None = None,
    out: Path | None = None,
) -> "Check":
    """List what to fix in an environment before training, worst first.

    TASK is played for about a minute by simple policies: standing still, constant actions, random
    ones, held and coloured ones. Or `data` are read instead. Each finding has its evidence and its
    fix; the end recommends a representation.

    Args:
        data: a data set, or its folder, in place of a task.
        steps: total steps to play or read; of each policy at least four episodes are played.
        seed: of the episodes and the held-out split.
        write: a new features file, with names, units, ranges and kinds as found.
        out: a page with pictures for a browser, a new file.
    """
    from jbrep.checking.check import check_data, check_task  # imports torch
    from jbrep.dataset import Dataset
    from jbrep.envs.description import as_task
    from jbrep.records.storage import exists, taken, write_new

    if (task is None) == (data is None):
        raise InputError("give a task, or else data, a folder from jbrep collect")
    for path in (write, out):
        if path and exists(path):
            raise taken(Path(path))
    if task is not None:
        found = check_task(as_task(task), steps, seed, write)
    else:
        known = data if isinstance(data, Dataset) else Dataset(data or "")
        found = check_data(known, steps, seed, write)
    if write:
        write_new(Path(write), found.features_file.encode())
    if out:
        from jbrep.checking.page import page

        write_new(Path(out), page(found).encode())
    return found


@checked
def collect(
    task: GivenTask,
    out: str | Path,
    steps: Steps,
    *,
    policy: Acting = "uniform",
    seed: RootSeed = 0,
    store_state: StoreState = False,
    shard_episodes: ShardEpisodes | None = None,
    num_envs: NumEnvs = 100,
    threads: Threads = None,
    retries: Retries = 0,
) -> "Dataset":
    """Collect the states that a policy visits.

    Run it again to resume. More `steps` extend a finished data set, as if it had been made at once.
    The number of environments or threads doesn't change the data. A robot that exists once needs
    `threads` 1. Whole shards are always kept. A run's policy is copied at the start, so that later
    training doesn't change the data.

    Args:
        task: whose environment is played; how readings that are missing are treated belongs to it.
        out: a folder: new, or with an unfinished or smaller data set of the same settings.
        policy: what acts: uniform, constant:drive=0.5, for the Jitterbug heuristic and trained (see
            jbrep policies), ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3; the folder of a run; or
            several with weights, one of which plays each episode: uniform:0.5+runs/a:0.5; or your
            own: mymodule:act, a function of an observation, a class of such functions, or a
            stable-baselines3 model.
    """
    from jbrep.collecting.collector import collect as run
    from jbrep.collecting.collector import usual_shard_episodes
    from jbrep.dataset import Dataset, DataSettings
    from jbrep.dataset.settings import TRAINED, parts_of
    from jbrep.envs.description import as_task
    from jbrep.play.sources import find_policy
    from jbrep.records.storage import exists

    folder, known = Path(out), as_task(task)
    if not known.reproducible:
        _note(
            f"{known.name} is not reproducible: no episode can be simulated again to verify the "
            "data set"
        )
    actor = find_policy(policy, folder, known)
    settings = DataSettings(
        task=known, policy=actor.settings(), steps=steps, seed=seed, store_state=store_state
    )
    settings = settings.replace(
        shard_episodes=shard_episodes or usual_shard_episodes(settings, folder, actor, retries)
    )
    files = actor.files()
    for part in parts_of(settings.policy):
        kept = folder / part.get("file", "")
        if part["kind"] == TRAINED and exists(kept) and kept.read_bytes() == files[kept.name]:
            _note(f"{kept} keeps the policy of {part['run']} at step {part['step']:,}")
    run(settings, folder, num_envs, threads, actor, retries)
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
    """Make an encoder from a data set; the parameters are those of `train_encoders`."""
    from jbrep.methods.registry import with_preset

    settings = with_preset(kind, preset, settings)
    return _fitter(data, out, device).fit(kind, name=name, **settings).encoder


@checked
def train_encoders(
    data: "Dataset | str | Path",
    out: str | Path,
    kind: str = "dae",
    *,
    latent: Sequence[int | str] = (),
    seeds: Annotated[int, Meta(ge=1)] | None = None,
    name: str | None = None,
    preset: str | None = None,
    device: str = "auto",
    **settings: Any,
) -> "Iterator[Fitted]":
    """Make encoders of a kind from a data set, one of each latent size and seed.

    All settings are checked at once; each encoder is made when the next one is asked for:

        for made in jbrep.train_encoders("data/face", "encoders", "dae", latent=[12, 8, 4]):
            print(made)

    Args:
        data: a folder from jbrep collect, of which 80 % of the episodes are learned from.
        out: a folder for the encoder files; a training that was stopped goes on from there.
        kind: one of dae, pca, slow, ...; jbrep train-encoder --help lists them with their settings.
        latent: sizes, or one; empty for a kind that has none.
        seeds: encoders of each size, with seeds 0, 1, ...: NAME-s0, NAME-s1, ...
        name: its name in files and tables; by default kind and size, such as dae-8.
        preset: named settings; for dae: authors, its authors' own.
        device: where to train: cpu, cuda, or auto.
        settings: of the kind, such as on="symmetry".
    """
    from jbrep.methods.registry import named_settings, with_preset

    sizes = [latent] if isinstance(latent, str) or not hasattr(latent, "__len__") else latent
    named = named_settings(kind, sizes, seeds, name, with_preset(kind, preset, settings))
    fitter = _fitter(data, out, device)
    for called, each in named:  # every mistake is reported before the first training
        fitter.plan(kind, name=called, **each)
    return (fitter.fit(kind, name=called, **each) for called, each in named)


@checked
def evaluate(
    encoders: Mapping[str, Any] | Sequence[Any] | Any,
    data: "Dataset | str | Path",
    out: str | Path | None = None,
    *,
    policy: Acting | None = None,
    truth: "Dataset | str | Path | None" = None,
) -> Evaluated:
    """Evaluate encoders on the held-out part of a data set.

    Args:
        encoders: one, several, or several by names of yours: files, names of shipped ones, torch
            modules, functions.
        data: the data set that they are evaluated on.
        out: a folder for evaluation.json; None to write nothing.
        policy: one that does the task well: a run's folder or a policy's name; by default the
            task's scripted policy, if it has one.
        truth: the data set that `data` was derived from, with what it hides: how well an encoder
            estimates what isn't seen.
    """
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.encoders.shipped import find_all
    from jbrep.evaluation.evaluation import EVALUATION
    from jbrep.records.storage import make_folder

    scaled = ScaledDataset.of(data)
    whole = Dataset(truth) if isinstance(truth, str | Path) else truth
    if whole is not None:
        from jbrep.evaluation.held_out import hidden_of

        hidden_of(scaled.dataset, whole)
    if out is not None:
        make_folder(Path(out), (EVALUATION,))
    from jbrep.evaluation.diagnosis import diagnose, write  # imports torch
    from jbrep.play.sources import find_good_policy

    own_rewards = bool(scaled.dataset.manifest.settings.reward)
    found = find_all(encoders, scaled.task)
    good = find_good_policy(policy, scaled.task, own_rewards)
    if out is None:
        return Evaluated(diagnose(found, scaled, good, whole))
    return Evaluated(write(found, scaled, Path(out), good, whole))


@checked
def evaluate_policy(
    policy: Acting,
    task: "Task | str | None" = None,
    *,
    episodes: Episodes = 20,
    threads: Threads = None,
    retries: Retries = 0,
) -> "NDArray[np.float64]":
    """Play a policy in the first of the episodes that every run is evaluated on.

    Args:
        policy: as `collect` takes it, or the file of an exported one.
        task: that is played, which a policy by name or of your own needs.

    Returns:
        Returns of the episodes, (episodes,).
    """
    from jbrep.envs.description import as_task
    from jbrep.play.sources import find_player

    player = find_player(policy, None if task is None else as_task(task))
    return player.returns(episodes, threads, retries)


@checked
def train(
    task: GivenDrawnTask,
    out: str | Path,
    *,
    algorithm: Algorithm = "sac",
    preset: Preset = "",
    encoder: Observed = "full",
    seed: Seed = 0,
    overrides: Overrides = NOTHING,
    normalize: Normalize = False,
    threads: Annotated[int, Meta(ge=1, le=4096)] | None = None,
    retries: Retries = 0,
    begin_from: Annotated[str, Meta(extra={"option": "from", "metavar": "RUN"})] = "",
    stop: Callable[[], bool] = lambda: False,
    **settings: Annotated[Any, TrainingSettings],
) -> Agent:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent. A checkpoint is written every
    minute, and on Ctrl-C before the command ends (td3 takes seconds to get there). Repeat it to
    resume, to the same result. The last checkpoint stays: with more `steps` training continues, to
    the result of one run of that length with the warm-up and evaluations of the shorter.

    Args:
        task: that it learns.
        out: a folder for this run.
        seed: random seed of the agent and its episodes.
        threads: threads that step a batch, as many as cores by default. 1 is one instance of
            another environment, as of a robot that exists once: num_envs is 1, in the preset modern
            unless one is named, and evaluations wait for the end of an episode.
        begin_from: begin with the final weights of a finished run of the same algorithm and sizes,
            such as one on another body; optimisers and SAC's entropy coefficient start anew.
        stop: asked before each rollout; once it is true, the run writes a checkpoint and stops.
        settings: of the training: steps, evaluate_every, evaluation_episodes, ...

    Raises:
        StoppedError: `stop` was true.
    """
    from jbrep.envs.make import is_one_robot
    from jbrep.rl.presets import MODERN

    if unknown := [name for name in settings if name not in TrainingSettings.__struct_fields__]:
        raise InputError(
            f"train has no {unknown[0]!r}: give a setting of {algorithm} as "
            f"overrides={{{unknown[0]!r}: ...}}"
        )
    preset, begin_from = str(preset), str(begin_from)  # paths are taken, too
    known = check_learner(task, algorithm, preset, encoder, begin_from)
    from jbrep.machine import cores
    from jbrep.rl.history import Bar
    from jbrep.rl.run import Run
    from jbrep.rl.training import Session, standing_of
    from jbrep.rl.training import train as train_run

    if one_robot := is_one_robot(known, threads):
        preset, settings = preset or MODERN, {**settings, "one_robot": True}
    overrides = {**overrides, "normalize": True} if normalize else overrides
    settings |= {"encoder": encoder, "seed": seed, "begin_from": begin_from}
    run = Run.of(known, algorithm, preset, overrides, **settings)
    if one_robot and run.learner.hyperparameters.num_envs > 1:
        run = run.replace(learner=run.learner.overridden({"num_envs": 1}))
    folder, found = Path(out), run.find_encoder()
    now = standing_of(run, folder, found)
    if now.ended:
        _note(f"the run in {folder} has already {now.ended.status}: nothing to do")
    else:
        _note_limits(now.settings)
    with closing(Bar(run.steps, f"{algorithm} on {found.name}")) as bar:
        session = Session(
            bar.show, stop=stop, keep_checkpoint=True, threads=threads or cores(), retries=retries
        )
        record = train_run(run, folder, session, found)
    return Agent(folder, record, None if isinstance(encoder, str | Path) else encoder)


@checked
def clone(
    data: "Dataset | str | Path",
    out: str | Path,
    *,
    encoder: Observed = "full",
    seed: Seed = 0,
    steps: TrainingSteps | None = None,
    overrides: Overrides = NOTHING,
    episodes: Annotated[int, Meta(ge=1, le=10_000)] = 50,
    threads: Threads = None,
    device: str = "cpu",
    **settings: Annotated[Any, CloneSettings],
) -> Agent:
    """Learn a policy from a data set alone: clone the one that acted, or improve on it.

    It learns from 80 % of the episodes; its actions are tested on the rest. Cloning keeps the epoch
    with the least held-out loss. Where the data's environment is installed, the policy plays it,
    and its returns stand beside the data's. The result is a run's folder, for every command that
    takes a policy. Run it again to resume.

    Args:
        data: a folder from jbrep collect or jbrep data import.
        out: a folder for this policy.
        seed: random seed of the initial weights and the order of the data.
        steps: gradient steps, at most, in whole epochs; by default 20,000, of TD3+BC 100,000.
        overrides: a setting of the network or its training, such as net_arch=[64,64],
            learning_rate=1e-3 or batch_size=512; of TD3+BC gamma, tau, policy_delay, ..., too; may
            be repeated.
        episodes: episodes to play, the same for every run.
        device: where to train: cpu, cuda, or auto.
        settings: method, loss, chunk, patience, alpha.
    """
    from jbrep.dataset import Dataset
    from jbrep.encoders.shipped import check_found

    how = CloneSettings(**settings)
    known = data if isinstance(data, Dataset) else Dataset(data)
    if isinstance(encoder, str | Path):
        check_found(str(encoder), known.task)
    from jbrep.cloning.clone import Job, learn  # imports torch

    of_run = {"steps": steps, "seed": seed, "final_episodes": episodes, "device": device}
    run, record = learn(Job.of(known, encoder, how, overrides, **of_run), Path(out), threads)
    if record.note:
        _note(record.note)
    return Agent(Path(out), run, None if isinstance(encoder, str | Path) else encoder, record)


def check_learner(
    task: "Task | str", algorithm: str, preset: str, encoder: Any, begin_from: str = ""
) -> "Task":
    """The task, if all that a learner is named by exists; it takes no time to find that out."""
    from jbrep.encoders.shipped import check_found
    from jbrep.envs.description import as_task
    from jbrep.rl.files import read_finished
    from jbrep.rl.presets import get_preset, usual_preset

    base = preset or usual_preset(algorithm)
    if not base.endswith(".toml"):
        get_preset(base, algorithm)
    if begin_from:
        read_finished(Path(begin_from))
    known = as_task(task)
    if isinstance(encoder, str | Path):
        check_found(str(encoder), known)
    return known


@checked
def study(
    study: "Study | Mapping[str, Any] | str | Path",
    out: str | Path | None = None,
    *,
    workers: Workers = None,
    backend: Backend = "local",
) -> "Report":
    """Train a grid of agents, and report what became of them.

    Args:
        study: a `Study`, what its file would hold as a dictionary, the file, or demo, which ships.
        out: a folder; one that was stopped goes on. By default runs/NAME of the study's file.
    """
    from jbrep.studies import Plan, Study, read_study, run_study
    from jbrep.studies.config import as_study
    from jbrep.studies.runner import BACKENDS
    from jbrep.text import counted

    if isinstance(study, str | Path):
        file = find_study(study)
        plan = Plan(read_study(file), Path(out or Path("runs", file.stem)), file)
    elif out:
        plan = Plan(study if isinstance(study, Study) else as_study(study), Path(out), None)
    else:
        raise InputError("give `out`, a folder for the study")
    run = choose(backend, BACKENDS, "backend")
    for notice in plan.study.notices:
        _note(notice)
    if crashed := run_study(plan, run, workers):
        _note(f"{counted(crashed, 'run')} crashed: run the study again to retry")
    return report(plan.folder)


def report(
    folder: str | Path,
    *,
    evaluation: Annotated[Sequence[str], Meta(extra={"metavar": "FOLDER"})] = (),
    out: str | Path | None = None,
) -> "Report":
    """Summarise what a study found, and write a page of it.

    Args:
        folder: of a study, of runs, or of the tables of a study.
        evaluation: an evaluation of these runs' encoders, from jbrep evaluate, to add to the
            tables; {task} stands for each task. May be repeated.
        out: a folder for the report; by default the study's own.
    """
    from jbrep.records.storage import exists

    evaluation = [evaluation] if isinstance(evaluation, str | Path) else evaluation
    if not exists(folder):
        raise InputError(f"{folder} is not the folder of a study: there is no such folder")
    from jbrep.reporting.report import make_report  # imports torch

    return make_report(Path(folder), Path(out) if out else None, [*map(str, evaluation)])


def _fitter(data: "Dataset | str | Path", out: str | Path, device: str) -> "Fitter":
    from jbrep.dataset import ScaledDataset
    from jbrep.methods.fit import Fitter

    scaled = ScaledDataset.of(data)
    for constant in scaled.constant_features:
        _note(f"{constant} is constant in the training part")
    return Fitter(scaled, Path(out), device)


def _note_limits(settings: "RunSettings") -> None:
    """Say of a run what can't come of it."""
    if settings.steps <= settings.learns_from:
        _note(
            f"{settings.learner} learns from step {settings.learns_from:,} on: nothing is learned "
            f"in {settings.steps:,} steps; give more, or another preset",
            level=4,
        )
    from jbrep.encoders import FULL

    features = settings.environment.features
    free = [each.name for each in features if each.low is None or each.high is None]
    is_seen = settings.representation == FULL and not settings.hyperparameters.normalize
    if is_seen and 0 < len(free) < len(features):
        _note(
            f"{len(free)} of {len(features)} features have no usual range ({free[0]}, ...), so "
            "they alone aren't scaled: give ranges in a file of `features`, or `normalize`",
            level=4,
        )
    if not settings.environment.reproducible:
        _note(
            f"{settings.task} is not reproducible: the same seed gives other numbers the next "
            "time, and a run that is stopped can't be resumed; the policy of its last checkpoint "
            "can be played and exported",
            level=4,
        )


def _note(line: str, level: int = 3) -> None:
    warnings.warn(line, Notice, stacklevel=level)
