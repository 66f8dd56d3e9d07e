"""Training runs together, in cohorts."""

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence

from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.records.record import to_plain
from jbrep.rl.agent import unchecked_distributions
from jbrep.rl.checkpoint import Snapshot, StoppedError
from jbrep.rl.cohort.cohort import Cohort, padded_size
from jbrep.rl.cohort.member import Member
from jbrep.rl.job import Ended, Job, Session

_Begun = tuple[Job, Snapshot | None]
_Kind = tuple[str, bool, int, int, str]
_EACH_ITS_OWN = ("representation", "encoder", "encoder_code", "encoder_seed", "seed", "from")


def train_together(jobs: Sequence[Job], session: Session) -> Iterator[Ended]:
    """Bring runs to their end: those together that can be, one cohort after another.

    What can be together are runs that share their settings, and begin anew or have checkpoints of
    the same step; and that observe no more numbers than their task has, or the same number. A run's
    result doesn't depend on which others are beside it.

    Yields:
        Each run, when it ends.

    Raises:
        StoppedError: the session is to stop; the runs' checkpoints are written.
    """
    groups = defaultdict[_Kind, list[_Begun]](list)
    for job in jobs:
        snapshot = job.checkpoint.read()
        groups[_kind(job, snapshot)].append((job, snapshot))
        del snapshot  # it holds a whole replay buffer
    for job in jobs:  # now that no checkpoint of another run is there
        job.keep_encoder()
    for kind in sorted(groups):
        with unchecked_distributions():
            yield from _train(groups.pop(kind), session)


def _kind(job: Job, snapshot: Snapshot | None) -> _Kind:
    """What is the same of all runs of a cohort; one that can't be continued is alone in its."""
    shared = {n: value for n, value in to_plain(job.settings).items() if n not in _EACH_ITS_OWN}
    alone = "" if job.run.task.reproducible else str(job.folder)
    text, is_new = json.dumps(shared, sort_keys=True), snapshot is None
    return text, is_new, job.history.first_step, padded_size(job), alone


def _begin(cohort: Cohort, snapshots: Sequence[Snapshot]) -> None:
    """Begin anew, or go on from where the members' snapshots were taken, if there are any."""
    if not snapshots:
        return cohort.begin()
    with cohort.members[0].job.checkpoint.resuming():
        try:
            return cohort.restore(snapshots)
        except EnvironmentFailedError as error:
            with cohort.member_of(error.lane).job.checkpoint.resuming():
                raise


def _train(begun: list[_Begun], session: Session) -> Iterator[Ended]:
    cohort = Cohort([Member(job, session.writers) for job, _ in begun])
    everyone = cohort.members
    others: list[Job] = []
    try:
        _begin(cohort, [snapshot for _, snapshot in begun if snapshot])
        if not everyone[0].job.history.evaluations:
            cohort.evaluate_amid()
        while cohort.goes_on:
            if cohort.failed:
                yield from (_end(member, session) for member in cohort.failed)
                cohort, snapshots = cohort.survivors()
                cohort.restore(snapshots)
            _tell(cohort, session)
            _save(cohort, session)
            for _ in range(cohort.rollout):
                cohort.act()
                cohort.evaluate_if_due(session.keep_checkpoint)
            cohort.learn()
        _tell(cohort, session)  # the last evaluation can take minutes
        if session.keep_checkpoint:
            _write(cohort)
        cohort.evaluate(Job.final_evaluation)
        _tell(cohort, session)
        yield from (_end(member, session) for member in cohort.members)
    except EnvironmentFailedError as error:
        cohort.member_of(error.lane).fail(error)
        yield from (_end(member, session) for member in cohort.failed)
        others = [member.job.anew() for member in cohort.members if not member.failed]
    finally:
        cohort.close()
        for member in everyone:
            member.agent.logger.close()
    del cohort, everyone  # a replay buffer is as large as that of those which follow
    yield from train_together(others, session)  # from their checkpoints


def _tell(cohort: Cohort, session: Session) -> None:
    for member in cohort.members:
        session.watch(member.job, cohort.step)


def _save(cohort: Cohort, session: Session) -> None:
    """Write all checkpoints, if it is time or the session is to stop."""
    stopping = session.stop()
    first = cohort.members[0].job.checkpoint
    if stopping or first.is_due(session.save_every, len(cohort.members)):
        _write(cohort)
    if stopping:
        raise StoppedError(cohort.step)


def _write(cohort: Cohort) -> None:
    cohort.write_to_agents()
    for member in cohort.members:
        if not member.failed:
            member.job.checkpoint.write(cohort.take(member))


def _end(member: Member, session: Session) -> Ended:
    """Write what a member leaves; its agent has its last weights."""
    return member.job, member.job.end(member.agent, member.failed, session.keep_checkpoint)
