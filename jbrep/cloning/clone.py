"""A policy that is learned from a data set, in the folder of a run, like those of jbrep rl."""

import hashlib
import math
import time
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta

from jbrep.cloning.objective import TD3BC, Cloning, PolicyInputs
from jbrep.dataset import Dataset
from jbrep.encoders import Encoder, save
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.environments import EnvironmentFailedError, envs_at_once
from jbrep.envs.make import is_batched
from jbrep.envs.names import environment_versions
from jbrep.envs.recording import Outcome, joined, whole_outcome
from jbrep.errors import InputError
from jbrep.machine import cpu
from jbrep.records.commit import commits
from jbrep.records.document import Document, read_document
from jbrep.records.record import Finite, to_plain
from jbrep.records.storage import exclusive, exists, make_folder, write_whole
from jbrep.rl import files
from jbrep.rl.history import History
from jbrep.rl.learner import Learner, usual_name
from jbrep.rl.policy import Trained, build, pack_whole
from jbrep.rl.presets import LINEAR, MODERN, argument
from jbrep.rl.run import Run
from jbrep.rl.run_settings import Cloned, RunSettings
from jbrep.rl.settings import BC, CloneSettings, Line
from jbrep.rl.training import packages, write_tables
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.text import Table, counted, interval, number, r2_text, wrapped
from jbrep.training.trainer import Epoch, Schedule, Trainer, get_device, single_thread
from jbrep.training.windows import Windows, count_windows, watched_windows

CLONE = "clone.json"
_CHECKPOINT = "training.safetensors"  # until the training has ended
_SAVE_EVERY = 10.0  # seconds between checkpoints, at least
_STEPS = {BC: 20_000, "td3+bc": 100_000}  # gradient steps where nothing is said
_AT_ONCE, _TIMES = 10, 10  # episodes that are played; parts of the longest episode
_FOR_NETWORK, _FOR_ALL = ("net_arch", "activation_fn"), ("learning_rate", "batch_size")
_FOR_TD3 = ("gamma", "tau", "policy_delay", "target_policy_noise", "target_noise_clip")
_BASES: dict[str, tuple[str, dict[str, Any]]] = {  # whose policy it is, by the loss
    "squared": ("td3", {}),
    "gaussian": ("ppo", {"net_arch": [256, 256], "batch_size": 256}),
}


class Part(NamedTuple):
    """How well some of the held-out actions are told."""

    name: str
    mse: Finite  # of actions scaled to [-1, 1]
    r2: Finite | None  # None where they don't vary


class Mean(NamedTuple):
    """The mean return of some episodes, with its 95 % interval; none where nothing varies."""

    episodes: Annotated[int, Meta(ge=1)]
    mean: Finite
    low: Finite | None
    high: Finite | None

    def __str__(self) -> str:
        shown = interval((self.mean, self.low, self.high), ",.4g")
        return f"{shown} in {counted(self.episodes, 'episode')}"


class CloneRecord(Document, frozen=True, kw_only=True):
    """clone.json: what is known of a policy that was learned from data."""

    format = "jbrep clone"
    format_version = 1

    epochs: tuple[Epoch, ...]
    best_epoch: Annotated[int, Meta(ge=1)]  # whose policy is kept
    error: Part  # of all actions
    actions: tuple[Part, ...]
    times: tuple[Part, ...]  # of ten parts of the longest held-out episode, by their steps
    data: Mean | None  # of the data's episodes; None without rewards
    policy: Mean | None  # None if it wasn't played
    note: Line  # why it wasn't, or why the two can't be compared; empty if they can

    def card(self, width: int | None) -> str:
        """What a reader wants to know of it."""
        parts = self.error, *(self.actions if len(self.actions) > 1 else ()), *self.times
        rows = [(each.name, number(each.mse, ".4f"), r2_text(each.r2)) for each in parts]
        kept = f"epoch {self.best_epoch} of {len(self.epochs)} is kept; held-out actions:"
        lines = [kept, Table("", ("", "error", "R²"), rows).text(width)]
        means = (("policy", self.policy), ("data", self.data))
        text = "; ".join(f"{name} {mean}" for name, mean in means if mean)
        return "\n".join(lines + ([wrapped(f"mean return [95 %]: {text}", width)] if text else []))


class Job(NamedTuple):
    """What to learn, once all of it has been checked."""

    data: Dataset
    encoder: BaseEncoder
    settings: RunSettings
    how: Cloned

    @classmethod
    def of(
        cls,
        data: Dataset,
        encoder: Any,
        how: CloneSettings,
        overrides: Mapping[str, Any],
        **of_run: Any,
    ) -> "Job":
        """A policy to learn from data, as `jbrep.clone` describes it; `of_run` are a run's fields.

        The run that it is written as is one of the algorithm whose policy it has.
        """
        algorithm, usual = _BASES[how.loss]
        of_training = (*_FOR_ALL, *(_FOR_TD3 if how.method != BC else ()))
        for name, value in overrides.items():
            if name not in (known := (*_FOR_NETWORK, *of_training)):
                raise InputError(f"{how.method} has no setting {name!r}: it has {', '.join(known)}")
            if str(value).startswith(LINEAR):
                raise InputError(f"{name} is {value}: it must be a number here, not a schedule")
        label = "-gaussian" if how.loss == "gaussian" else ""
        label += f"-chunk{how.chunk}" if how.chunk > 1 else ""
        learner = Learner(
            name=usual_name(f"{how.method}{label}", overrides),
            algorithm=algorithm,
            preset=MODERN,
            overrides={**usual, **overrides, "normalize": True},
        )
        of_run["steps"] = of_run["evaluate_every"] = (
            _STEPS[how.method] if of_run["steps"] is None else of_run["steps"]
        )
        of_run["evaluation_episodes"] = min(_AT_ONCE, of_run["final_episodes"])
        run = Run(task=data.task, learner=learner, encoder=encoder, **of_run)
        found, chosen = run.find_encoder(), learner.hyperparameters
        given = {name: argument(algorithm, chosen, name) for name in of_training}
        cloned = Cloned(**to_plain(how), data=data.fingerprint)
        settings = run.settings(found).replace(
            hyperparameters=chosen.replace(algorithm_kwargs=given, noise=None, num_envs=1),
            cloned=cloned,
        )
        return cls(data, found, settings, cloned)


def learn(
    job: Job, folder: Path, threads: int | None = None
) -> tuple[files.RunRecord, CloneRecord]:
    """Learn a policy and write its folder, unless it is complete; what was killed goes on."""
    make_folder(folder, (*files.OWN, CLONE, _CHECKPOINT))
    if exists(folder / files.CHECKPOINT):
        raise InputError(f"{folder} has a run of jbrep rl: choose another folder")
    with exclusive(folder), single_thread():
        if not exists(folder / files.RUN):
            _learn(job, folder, threads)
        run = files.read_run(folder)
        if differing := run.settings.differing(job.settings):
            raise InputError(f"{folder} has another run: {differing}; choose another folder")
        return run, read_document(folder / CLONE, CloneRecord)


def _learn(job: Job, folder: Path, threads: int | None) -> None:
    began, settings, how = time.monotonic(), job.settings, job.how
    seen = PolicyInputs(job.data, job.encoder)
    if how.method != BC and not seen.reward_varies:
        raise InputError(
            f"{how.method} needs rewards that vary, and {job.data.folder} has none: jbrep data "
            f"derive --reward gives some, or take the method {BC}"
        )
    trained = build(settings, job.encoder, folder)._replace(statistics=seen.statistics)
    objective = Cloning(trained.policy, how.chunk)
    if how.method != BC:
        objective = TD3BC(trained.policy, how.alpha, settings.hyperparameters.algorithm_kwargs)
    trainer, watched = _train(job, objective, seen, folder / _CHECKPOINT)
    objective.load_state_dict(trainer.best)
    objective.eval()
    parts = _parts(objective, watched, job.data)
    objective.to("cpu")
    history, played, note, theirs = History(), None, "", job.data.episodes.get("return")
    try:
        outcome = _play(trained, settings, threads)
    except (InputError, ModuleNotFoundError) as error:
        is_log = job.data.manifest.settings.is_imported
        is_known = not is_log or isinstance(error, EnvironmentFailedError)
        why = str(error) if is_known else f"{job.data.folder} names no environment"
        note = (
            f"the policy wasn't played ({why}): a low error doesn't say what it returns, as errors "
            "lead to states that aren't in the data, and to larger errors"
        )
    else:
        history.add(settings.steps, outcome)
        played = _mean(outcome.returns, trained)
        if job.data.manifest.settings.reward:
            note = "the data's rewards aren't the environment's: their returns can't be compared"
    record = CloneRecord(
        epochs=tuple(trainer.history),
        best_epoch=trainer.best_epoch,
        **parts,
        data=None if theirs is None else _mean(theirs, trained),
        policy=played,
        note=note,
    )
    if isinstance(job.encoder, Encoder):
        save(job.encoder, folder / files.ENCODER)
    policy = pack_whole(trained)
    write_whole(folder / files.POLICY, policy)
    record.write(folder / CLONE)
    files.RunRecord(
        status=files.FINISHED,
        reason=None,
        settings=settings,
        latent_size=job.encoder.latent_size,
        steps=settings.steps,
        seconds=round(time.monotonic() - began, 1),
        versions=packages() | (environment_versions(job.data.task) if played else {}),
        commits=commits(),
        cpu=cpu(),
        tables=write_tables(folder, history),
        policy_sha256=hashlib.sha256(policy).hexdigest(),
    ).write(folder / files.RUN)  # last: it is complete where this exists
    (folder / _CHECKPOINT).unlink(missing_ok=True)


def _train(
    job: Job, objective: Cloning, seen: PolicyInputs, checkpoint: Path
) -> tuple[Trainer, Windows]:
    """Train to the end; the trainer, and held-out windows."""
    settings, device = job.settings, get_device(job.settings.device)
    objective.to(device)
    count = count_windows(seen, objective.horizon)
    given = settings.hyperparameters.algorithm_kwargs
    size = min(given["batch_size"], count)
    epochs = math.ceil(settings.steps / math.ceil(count / size))
    schedule = Schedule(epochs, size, given["learning_rate"], settings.seed)
    watched = watched_windows(seen, objective.horizon, device)
    windows = Windows(seen, seen.train, objective.horizon, device)
    trainer = Trainer(objective, schedule, windows, watched)
    identity = {**to_plain(settings), "torch": packages()["torch"]}
    if exists(checkpoint):
        trainer.restore(identity, checkpoint)
    saved, patience = time.monotonic(), job.how.patience if job.how.method == BC else None
    for _ in trainer.with_progress(settings.learner, patience):
        if time.monotonic() - saved > _SAVE_EVERY:
            trainer.save(identity, checkpoint)
            saved = time.monotonic()
    trainer.save(identity, checkpoint)
    return trainer, watched


def _parts(objective: Cloning, watched: Windows, data: Dataset) -> dict[str, Any]:
    """The parts of a record, of held-out windows."""
    errors, actions = objective.errors(watched)
    deviations = actions - actions.mean(axis=(0, 1))

    def part(name: str, *place: Any) -> Part:
        mse, variance = (float(np.square(each[place]).mean()) for each in (errors, deviations))
        return Part(name, mse, 1 - mse / variance if variance > 1e-12 else None)

    steps = data["step"][watched.first_rows]
    edges = np.unique(np.linspace(0, steps.max() + 1, _TIMES + 1).astype(int))
    named = [(f"steps {a:,}-{b - 1:,}", (a <= steps) & (steps < b)) for a, b in pairwise(edges)]
    return {
        "error": part("all", ...),
        "actions": tuple(part(name, ..., i) for i, name in enumerate(data.task.named_actions)),
        "times": tuple(part(name, own) for name, own in named if own.any()),
    }


def _play(trained: Trained, settings: RunSettings, threads: int | None) -> Outcome:
    """What comes of the episodes that every run is evaluated on."""
    count, most = settings.final_episodes, settings.evaluation_episodes
    if not is_batched(trained.task):
        most = min(most, threads or most)
    with envs_at_once(trained.task, most, threads, 0) as envs:
        seeds = range(files.EVALUATION_SEED, files.EVALUATION_SEED + count, envs.num_envs)
        begin = partial(trained.begin, trained.task, ())
        return joined((whole_outcome(envs, begin, seed) for seed in seeds), count)


def _mean(returns: Any, trained: Trained) -> Mean:
    bounds = Bounds.of(trained.task.return_floor, trained.task.return_ceiling)
    found = mean_within(np.asarray(returns, np.float64), bounds, LEVEL)
    low, high = (float(end) if np.isfinite(end) else None for end in (found.low, found.high))
    return Mean(len(returns), float(found.value), low, high)
