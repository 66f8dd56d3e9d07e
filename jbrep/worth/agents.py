"""Small agents on codes: the most direct way to find out what these are worth."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from joblib import cpu_count

from jbrep.envs.task import Task
from jbrep.evaluate.evaluation import Score, score
from jbrep.progress import Progress
from jbrep.rl.files import last_returns, read_evaluations
from jbrep.rl.job import Job, Session
from jbrep.rl.run import Run
from jbrep.rl.trainers import train_jobs
from jbrep.stats.intervals import LEVEL, mean_within
from jbrep.worth.offline import EPISODES, bounds_of

_ALGORITHM = "sac"
STEPS, RUNS = 100_000, 2  # of a run, of a code


def learned(encoders: Mapping[str, Any], task: Task, folder: Path) -> dict[str, Score]:
    """What agents of the usual preset return in the end, by the code that they observe.

    All learn together. Stopped or killed, the same call resumes them.

    Args:
        encoders: by label, as a run takes them.
        task: that is learned.
        folder: for the runs.

    Raises:
        InputError: the folder holds other runs; or as `Run.settings`.
    """
    jobs = {
        (label, seed): Job(
            Run.of(
                task,
                _ALGORITHM,
                encoder=encoder,
                representation=label,
                seed=seed,
                steps=STEPS,
                evaluate_every=STEPS,
                final_episodes=EPISODES,
            ),
            folder / label / f"seed-{seed}",
            cpu_count(),
        )
        for label, encoder in encoders.items()
        for seed in range(RUNS)
    }
    done = dict.fromkeys(jobs.values(), 0)
    with Progress(total=STEPS * len(jobs), unit="step", unit_scale=True, desc="agents") as bar:

        def watch(job: Job, step: int) -> None:
            bar.update(min(step, STEPS) - done[job])
            done[job] = min(step, STEPS)

        for _ in train_jobs([*jobs.values()], Session(watch)):
            pass
    found = {}
    for label in encoders:
        own = [jobs[label, seed].folder for seed in range(RUNS)]
        returns = np.concatenate([last_returns(read_evaluations(each)) for each in own])
        found[label] = score(mean_within(returns, bounds_of(task), LEVEL))
    return found
