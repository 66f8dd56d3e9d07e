"""Training runs, by the trainer that each names."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from stable_baselines3.common.logger import KVWriter

from jbrep.records.lock import exclusive
from jbrep.records.storage import make_folder
from jbrep.rl.cohort.trainer import train_together
from jbrep.rl.files import CHECKPOINT, FAILED, OWN, RunRecord
from jbrep.rl.job import Ended, Job, Session, Watch
from jbrep.rl.run import Run
from jbrep.rl.sb3 import train_in_turn
from jbrep.rl.settings import COHORT, SB3
from jbrep.training.trainer import single_torch_thread

_FUNCTIONS = {COHORT: train_together, SB3: train_in_turn}


def train(
    run: Run,
    folder: Path,
    watch: Watch = lambda step, mean: None,
    save_every: float = 60,
    stop: Callable[[], bool] = lambda: False,
    writers: Sequence[KVWriter] = (),
    keeps: bool = False,
) -> RunRecord:
    """Train an agent and write its folder, unless the run has ended already.

    A run that was killed or stopped resumes from its checkpoint, to the same bits.

    Args:
        run: what to train.
        folder: for this run alone.
        watch: called with the steps so far and the mean return of the last evaluation.
        save_every: seconds between checkpoints.
        stop: asked before each rollout; once it is true, the run writes a checkpoint and stops.
        writers: of stable-baselines3's logger, that get what TensorBoard gets.
        keeps: whether the checkpoint stays, from which the same run with more steps goes on.

    Returns:
        The contents of run.json.

    Raises:
        InputError: as `Run.settings`; or the folder holds another run, or is in use.
        StoppedError: `stop` was true.
    """
    session = Session(lambda job, *told: watch(*told), save_every, stop, writers, keeps)
    ((_, record),) = train_jobs([Job(run, folder)], session)
    return record


def train_jobs(jobs: Sequence[Job], session: Session) -> Iterator[Ended]:
    """The same for several runs: together, where their trainer can.

    Yields:
        Each run with the contents of its run.json, when it has ended.

    Raises:
        InputError, StoppedError: as `train`.
    """
    with ExitStack() as stack:
        for job in jobs:
            if not job.result:
                make_folder(job.folder, OWN)
                stack.enter_context(exclusive(job.folder))
        stack.enter_context(single_torch_thread())
        results = {job: job.result for job in jobs}
        yield from ((job, result) for job, result in results.items() if result)
        for trainer, train_own in _FUNCTIONS.items():
            own = [job for job in jobs if job.settings.trainer == trainer and not results[job]]
            for job, record in train_own(own, session):
                if not session.keeps or record.status == FAILED:
                    (job.folder / CHECKPOINT).unlink(missing_ok=True)
                yield job, record
