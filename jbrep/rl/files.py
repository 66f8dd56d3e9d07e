"""A run's folder: what a run leaves there, written and read."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Meta

from jbrep.envs.infos import by_name
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.commit import Commits
from jbrep.records.document import Document, read_document
from jbrep.records.record import Sha256, Version
from jbrep.records.storage import exists
from jbrep.records.tables import read_rows
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import (
    MAX_EPISODES,
    MAX_STEPS,
    Line,
    Name,
)

POLICY_SUFFIX = ".safetensors"
RUN = "run.json"  # written last: its presence means that the run has ended
POLICY = "policy.safetensors"
POLICY_ZIP = "policy.zip"  # the same for stable-baselines3; jbrep reads it elsewhere only
CHECKPOINT = "checkpoint.safetensors"  # of a study's run, until it ends
SOON = "which a run writes about a minute after its start"  # of either, for messages
BEGINNING = "beginning.safetensors"  # the policy that it begins with, if that is another run's
ENCODER = "encoder.safetensors"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
INFOS = "infos.csv"  # where the environment tells numbers
_BEFORE = "progress", "error.txt", "tensorboard", "wandb"  # of a run that has just begun
OWN = (
    RUN,
    CHECKPOINT,
    BEGINNING,
    ENCODER,
    EPISODES,
    EVALUATIONS,
    INFOS,
    *_BEFORE,
)  # see `make_folder`
EVALUATION_SEED = 1 << 31  # of an evaluation's first episode; seeds in training are smaller
FINISHED: Final = "finished"
FAILED: Final = "failed"


class RunRecord(Document, frozen=True, kw_only=True):
    """run.json: a run that has ended."""

    format = "jbrep run"
    format_version = 7

    status: Literal["finished", "failed"]
    reason: Line | None  # why it failed
    settings: RunSettings
    latent_size: Annotated[int, Meta(ge=1, le=1 << 20)]
    steps: Annotated[int, Meta(ge=0, le=MAX_STEPS)]
    seconds: Annotated[float, Meta(ge=0, le=1e12)]
    versions: Mapping[Version, Version]  # by package
    commits: Commits
    cpu: Line
    tables: Mapping[Name, Sha256]  # of the files of its episodes, evaluations and infos
    policy_sha256: Sha256 | None  # of its policy's file; null if it failed

    def check(self) -> None:
        if (self.status == FINISHED) != (self.policy_sha256 is not None):
            raise InputError(f"it has {self.status}, but policy_sha256 is {self.policy_sha256}")
        if EVALUATIONS not in self.tables:
            raise InputError(f"tables.{EVALUATIONS} is missing")


class PolicyHeader(Document, frozen=True, kw_only=True):
    """The header of a policy's file.

    Attributes:
        settings: of the run.
        encoder: the header of its encoder; None if that is code.
        run: what the run is called.
        step: of training.
        finished: whether training was over.
    """

    format = "jbrep policy"
    format_version = 5

    settings: RunSettings
    encoder: dict[str, Any] | None
    run: Line
    step: Annotated[int, Meta(ge=0, le=MAX_STEPS)]
    finished: bool


class ZipHeader(Document, frozen=True, kw_only=True):
    """What policy.zip says beside what stable-baselines3 reads.

    Attributes:
        environment: of the run.
        encoder: the fingerprint of that through which its agent observes.
        representation: what tables call that.
    """

    format = "jbrep policy.zip"
    format_version = 2

    environment: Task
    encoder: Sha256
    representation: Name


class Episode(NamedTuple):
    """An episode of training."""

    step: int  # of training, over all lanes, at its end
    lane: int
    episode_return: float
    length: int  # control steps
    diverged: bool  # whether its physics did, which ended it


class Evaluation(NamedTuple):
    """An episode of the deterministic policy."""

    step: int  # of training before it
    episode: int  # the same number has the same start
    episode_return: float


class Info(NamedTuple):
    """A number in `info` at the end of an episode of the deterministic policy."""

    step: int  # of training before it
    episode: int  # of the evaluation
    name: str
    value: float  # 1 or 0 of a truth; of is_success 1 if it was true at any step


def is_run(folder: Path) -> bool:
    """Whether a folder is of a run that has ended or has written a checkpoint."""
    return exists(folder / RUN) or exists(folder / CHECKPOINT)


def check_begun(folder: Path) -> None:
    """Make sure that a folder isn't of a run that has only just begun."""
    if exists(folder / ENCODER) and not is_run(folder):
        raise InputError(f"the run in {folder} has no {CHECKPOINT} yet, {SOON}")


def runs_below(folder: Path) -> list[Path]:
    """The folders of the runs below a folder that have finished or failed, in order."""
    return sorted(file.parent for file in folder.rglob(RUN))


def is_policy_file(path: Path) -> bool:
    """Whether this is a policy's file as `jbrep.rl.policy_file` writes it."""
    return (
        path.suffix == POLICY_SUFFIX and container.peek(path).get("format") == PolicyHeader.format
    )


def read_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run: ascending steps, each with the same episodes from 0.

    The last one may have more of them.

    Raises:
        DamageError: as `read_run`, or the table isn't what the run wrote.
    """
    path = folder / EVALUATIONS
    evaluations = read_rows(path, Evaluation, read_run(folder).tables[EVALUATIONS])
    by_step = [(step, [*of_step]) for step, of_step in groupby(evaluations, lambda row: row.step)]
    steps, counts = [step for step, _ in by_step], [len(of_step) for _, of_step in by_step]
    if (
        any([row.episode for row in of_step] != [*range(len(of_step))] for _, of_step in by_step)
        or steps != sorted(set(steps))
        or steps[-1:] > [MAX_STEPS]
        or max(counts, default=0) > MAX_EPISODES
        or len(set(counts[:-1])) > 1
        or counts[-1:] < counts[:1]
    ):
        raise DamageError(
            f"{path} is damaged or not a table of evaluations: it must have the same episodes at "
            "every step, or more at the last"
        )
    return evaluations


def read_infos(folder: Path) -> list[Info]:
    """The numbers of a run's evaluations, to the last bit; nothing where none are told.

    Raises:
        DamageError: as `read_run`, or the table isn't what the run wrote.
    """
    sha256 = read_run(folder).tables.get(INFOS)
    return read_rows(folder / INFOS, Info, sha256) if sha256 else []


def last_infos(infos: Sequence[Info], evaluations: Sequence[Evaluation]) -> dict[str, list[float]]:
    """The numbers of the last evaluation's episodes, by name."""
    own = [{row.name: row.value} for row in infos if row.step == evaluations[-1].step]
    return by_name(own)


def last_returns(evaluations: Sequence[Evaluation]) -> list[float]:
    """The returns of the last evaluation."""
    return [row.episode_return for row in evaluations if row.step == evaluations[-1].step]


def read_run(folder: Path) -> RunRecord:
    """What run.json says of a run that has ended.

    Raises:
        DamageError: it is damaged or something else.
    """
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no finished run in {folder}: {RUN} is missing")
    return read_document(path, RunRecord)


def read_finished(folder: Path) -> tuple[RunRecord, str]:
    """The same of a run that has ended well, and the SHA-256 of its policy's file.

    Raises:
        DamageError: as `read_run`.
    """
    run = read_run(folder)
    if run.policy_sha256 is None:
        raise InputError(f"the run in {folder} {run.status}: it has no policy")
    return run, run.policy_sha256
