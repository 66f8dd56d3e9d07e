"""Small agents on codes: the most direct way to find out what these are worth."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, Notice
from jbrep.evaluate.evaluation import Score, score
from jbrep.machine import cores
from jbrep.progress import Progress
from jbrep.rl.files import FAILED, RunRecord, last_returns, read_evaluations
from jbrep.rl.job import Job, Session
from jbrep.rl.run import Run
from jbrep.rl.trainers import train_jobs
from jbrep.stats.intervals import LEVEL, mean_within
from jbrep.text import slug
from jbrep.worth.offline import EPISODES, bounds_of

_ALGORITHM = "sac"
STEPS, RUNS = 100_000, 2  # of a run, of a code
_MOST_LETTERS = 100  # of what a run calls its representation


def learned(encoders: Mapping[str, Any], task: Task, folder: Path) -> dict[str, Score]:
    """What agents of the usual preset return in the end, by the code that they observe.

    All learn together. Stopped or killed, the same call resumes them.

    Args:
        encoders: by label, as a run takes them.
        task: that is learned.
        folder: for the runs.

    Raises:
        InputError: the folder holds other runs; a run failed before there was a return; or as
            `Run.settings`.
    """
    jobs = {
        (label, seed): _job(task, label, encoder, seed, folder)
        for label, encoder in encoders.items()
        for seed in range(RUNS)
    }
    done = {job.folder: 0 for job in jobs.values()}  # a job is made anew where another's fails
    with Progress(total=STEPS * len(jobs), unit="step", unit_scale=True, desc="agents") as bar:

        def watch(job: Job, step: int) -> None:
            bar.update(min(step, STEPS) - done[job.folder])
            done[job.folder] = min(step, STEPS)

        trained = train_jobs([*jobs.values()], Session(watch))
        ended = {job.folder: record for job, record in trained}
    found = {}
    for label in encoders:
        own = [jobs[label, seed] for seed in range(RUNS)]
        returns = np.concatenate([_returns(job, ended[job.folder]) for job in own])
        found[label] = score(mean_within(returns, bounds_of(task), LEVEL))
    return found


def _job(task: Task, label: str, encoder: Any, seed: int, folder: Path) -> Job:
    """A run on a code, by its label."""
    name = slug(label)[-_MOST_LETTERS:]
    run = Run.of(
        task,
        _ALGORITHM,
        encoder=encoder,
        representation=name,
        seed=seed,
        steps=STEPS,
        evaluate_every=STEPS,
        final_episodes=EPISODES,
    )
    return Job(run, folder / name / f"seed-{seed}", cores())


def _returns(job: Job, record: RunRecord) -> Array:
    """The last returns of an agent; of one that failed the least possible, or its worst.

    Raises:
        InputError: it failed before its first evaluation, and no return is the least possible.
    """
    evaluations = read_evaluations(job.folder)
    if record.status != FAILED:
        return np.array(last_returns(evaluations))
    warnings.warn(f"{job.settings.name} failed: {record.reason}", Notice, stacklevel=2)
    least = bounds_of(job.run.task).low
    if not np.isfinite(least):
        if not evaluations:
            raise InputError(f"{job.settings.name} has no return to count: {record.reason}")
        least = min(each.episode_return for each in evaluations)
    return np.full(EPISODES, least)
