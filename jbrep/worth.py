"""What codes are worth: what small agents return that observe them; see docs/worth.md."""

import time
import warnings
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.dataset import Dataset
from jbrep.encoders import FULL, find
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError, Notice
from jbrep.evaluate.evaluation import EVALUATION, Evaluation, Score, Worth, score
from jbrep.machine import cores
from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.rl.files import FAILED, last_returns, read_evaluations
from jbrep.rl.run import Run
from jbrep.rl.training import Session, train
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.study.tables import references_of
from jbrep.text import slug

_ALGORITHM = "sac"
STEPS, RUNS = 100_000, 2  # of a run, of a code
EPISODES = 20  # of the last evaluation of each agent
_MOST_LETTERS = 100  # of what a run calls its representation


def check(data: Dataset) -> None:
    """Check, before anything else takes time, that agents can learn what the data are of."""
    reason = "gives other rewards" if data.manifest.settings.reward else ""
    try:
        with closing(Lanes(data.task, 1)):
            pass
    except (InputError, ModuleNotFoundError):
        reason = "can't be made here"
    if reason:
        raise InputError(
            f"the environment of {data.folder} {reason}: no agent can be trained; without --agents "
            "codes are judged by the data alone"
        )


def add_worth(
    evaluation: Evaluation, encoders: Mapping[str, BaseEncoder], task: Task, folder: Path
) -> Evaluation:
    """Train small agents on codes, and add what these return to an evaluation and its file.

    What the evaluation has already stays.

    Args:
        evaluation: of the encoders.
        encoders: by label; the full observation is compared with them.
        task: that is learned.
        folder: of the evaluation; the runs are kept there, and go on if they were stopped.
    """
    path = folder / EVALUATION
    with exclusive(path, beside=True):
        worth = evaluation.worth or _begun(task)
        if worth.returns:
            return evaluation
        began = time.process_time()
        try:
            every = {FULL: find(FULL, task), **encoders}
            worth = worth.replace(returns=learned(every, task, folder / "agents"))
        finally:  # the time of agents that were stopped counts
            worth = worth.replace(seconds=worth.seconds + time.process_time() - began)
            evaluation = evaluation.replace(worth=worth)
            evaluation.write(path)
    return evaluation


def _begun(task: Task) -> Worth:
    """What is known before agents have learned: what policies return that don't."""
    played = references_of(task, EPISODES)
    means = {policy: float(returns.mean()) for policy, returns in played.items()}
    return Worth(runs=RUNS, steps=STEPS, episodes=EPISODES, references=means)


def learned(encoders: Mapping[str, Any], task: Task, folder: Path) -> dict[str, Score]:
    """What agents of the usual preset return in the end, by the code that they observe.

    All learn together. Stopped or killed, the same call resumes them. One that fails counts as in
    studies: with the least possible return, or the worst that any of them had.

    Args:
        encoders: by label, as a run takes them.
        task: that is learned.
        folder: for the runs.
    """
    names = {label: slug(label)[-_MOST_LETTERS:] for label in encoders}
    if len({*names.values()}) < len(names):
        name, count = Counter(names.values()).most_common(1)[0]
        raise InputError(
            f"{count} of the encoders would be called {name} as folders: give them other names"
        )
    runs = {
        folder / names[label] / f"seed-{seed}": _run(task, names[label], encoder, seed)
        for label, encoder in encoders.items()
        for seed in range(RUNS)
    }
    returns = _returns(runs, task)
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    found = {}
    for label in encoders:
        own = [returns[folder / names[label] / f"seed-{seed}"] for seed in range(RUNS)]
        found[label] = score(mean_within(np.concatenate(own), bounds, LEVEL))
    return found


def _returns(runs: Mapping[Path, Run], task: Task) -> dict[Path, Array]:
    """The last returns of each agent, (20,), by folder; see `learned` for those that failed."""
    session = Session(threads=cores())
    records = {
        folder: train(run, folder, session) for folder, run in Progress(runs.items(), desc="agents")
    }
    evaluations = {folder: read_evaluations(folder) for folder in runs}
    least = task.return_floor
    if least is None:
        seen = [each.episode_return for several in evaluations.values() for each in several]
        least = min(seen, default=None)
    found = {}
    for folder, record in records.items():
        if record.status != FAILED:
            found[folder] = np.array(last_returns(evaluations[folder]))
            continue
        warnings.warn(f"{record.settings.name} failed: {record.reason}", Notice, stacklevel=2)
        if least is None:
            raise InputError(f"{record.settings.name} has no return to count: {record.reason}")
        found[folder] = np.full(EPISODES, least)
    return found


def _run(task: Task, name: str, encoder: Any, seed: int) -> Run:
    """A run on a code, by its name."""
    return Run.of(
        task,
        _ALGORITHM,
        encoder=encoder,
        representation=name,
        seed=seed,
        steps=STEPS,
        evaluate_every=STEPS,
        final_episodes=EPISODES,
    )
