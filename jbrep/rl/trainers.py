"""Training runs, by the trainer that each names."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from jbrep.records.lock import exclusive
from jbrep.records.storage import make_folder
from jbrep.rl.cohort.trainer import train_together
from jbrep.rl.files import CHECKPOINT, FAILED, OWN, RunRecord, read_run
from jbrep.rl.job import Ended, Job, Session
from jbrep.rl.run import Run
from jbrep.rl.sb3 import train_in_turn
from jbrep.rl.settings import COHORT, SB3
from jbrep.training.trainer import single_thread

_ALONE = Session()
_FUNCTIONS = {COHORT: train_together, SB3: train_in_turn}


def train(run: Run, folder: Path, session: Session = _ALONE) -> RunRecord:
    """Train an agent and write its folder, unless the run has ended already.

    A run that was killed or stopped resumes from its checkpoint, to the same bits.

    Args:
        run: what to train.
        folder: for this run alone.
        session: what goes on around training.

    Returns:
        The contents of run.json; where a run that went on with more steps failed, why: its files
        are those of the steps before.

    Raises:
        StoppedError: the session's `stop` was true.
    """
    ((_, record),) = train_jobs([Job(run, folder)], session)
    return record


def train_jobs(jobs: Sequence[Job], session: Session) -> Iterator[Ended]:
    """The same for several runs: together, where their trainer can.

    Yields:
        Each run with the contents of its run.json, when it has ended.
    """
    with ExitStack() as stack:
        for job in jobs:
            if not job.result:
                make_folder(job.folder, OWN)
                stack.enter_context(exclusive(job.folder))
        stack.enter_context(single_thread())
        results = {job: job.result for job in jobs}
        for job in jobs:
            if not results[job]:
                job.check_can_go_on()
        yield from ((job, result) for job, result in results.items() if result)
        for trainer, train_own in _FUNCTIONS.items():
            own = [job for job in jobs if job.settings.trainer == trainer and not results[job]]
            for job, record in train_own(own, session):
                keeps = session.keep_checkpoint and record.status != FAILED
                if not keeps and not read_run(job.folder).settings.differing(record.settings):
                    (job.folder / CHECKPOINT).unlink(missing_ok=True)
                yield job, record
