"""Training runs, by the trainer that each names."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter

from jbrep.records.lock import exclusive
from jbrep.records.storage import make_folder
from jbrep.rl.cohort.trainer import train_together
from jbrep.rl.history import Watch
from jbrep.rl.job import Job, Session
from jbrep.rl.names import COHORT, SB3
from jbrep.rl.run import Run
from jbrep.rl.sb3.trainer import train_in_turn
from jbrep.training.trainer import single_torch_thread

_FUNCTIONS = {COHORT: train_together, SB3: train_in_turn}


def train(
    run: Run,
    folder: Path,
    watch: Watch = lambda step, mean: None,
    save_every: float = 60,
    stop: Callable[[], bool] = lambda: False,
    writers: Sequence[KVWriter] = (),
) -> dict[str, Any]:
    """Train an agent and write its folder, unless the run has ended already.

    A run that was killed or stopped resumes from its checkpoint, to the same bits.

    Args:
        run: what to train.
        folder: for this run alone.
        watch: called with the steps so far and the mean return of the last evaluation.
        save_every: seconds between checkpoints.
        stop: asked before each rollout; once it is true, the run writes a checkpoint and stops.
        writers: of stable-baselines3's logger, that get what TensorBoard gets.

    Returns:
        The contents of run.json.

    Raises:
        InputError: as `Run.check`; or the folder holds another run, or is in use.
        StoppedError: `stop` was true.
    """

    def watch_it(folder: Path, step: int, mean: float | None) -> None:
        watch(step, mean)

    return dict(train_all({folder: run}, watch_it, save_every, stop, writers))[folder]


def train_all(
    runs: Mapping[Path, Run],
    watch: Callable[[Path, int, float | None], None] = lambda folder, step, mean: None,
    save_every: float = 60,
    stop: Callable[[], bool] = lambda: False,
    writers: Sequence[KVWriter] = (),
) -> Iterator[tuple[Path, dict[str, Any]]]:
    """The same for several runs, by their folders: together, where their trainer can.

    Yields:
        Each folder with the contents of its run.json, when the run has ended.

    Raises:
        InputError, StoppedError: as `train`.
    """
    session = Session(lambda job, *told: watch(job.folder, *told), save_every, stop, writers)
    jobs = [Job(run, folder) for folder, run in runs.items()]
    with ExitStack() as stack:
        for job in jobs:
            if not job.result:
                make_folder(job.folder)
                stack.enter_context(exclusive(job.folder))
        stack.enter_context(single_torch_thread())
        results = {job: job.result for job in jobs}
        yield from ((job.folder, result) for job, result in results.items() if result)
        for trainer, train_jobs in _FUNCTIONS.items():
            own = [job for job in jobs if job.run.trainer == trainer and not results[job]]
            yield from ((job.folder, result) for job, result in train_jobs(own, session))
