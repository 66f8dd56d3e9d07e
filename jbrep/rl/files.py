"""A run's folder: what a run leaves there, written and read."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from msgspec import Meta

from jbrep.envs.infos import by_name
from jbrep.errors import InputError
from jbrep.records import container
from jbrep.records.commit import Commits
from jbrep.records.document import Document, read_document
from jbrep.records.record import Sha256, Version
from jbrep.records.storage import exists
from jbrep.records.tables import read_rows
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_STEPS, Line, Name

POLICY_SUFFIX = ".safetensors"
RUN = "run.json"  # written last: its presence means that the run has ended
POLICY = "policy.safetensors"
POLICY_ZIP = "policy.zip"  # the same for stable-baselines3
CHECKPOINT = "checkpoint.safetensors"  # of a study's run, until it ends
SOON = "which a run writes about a minute after its start"  # of either, for messages
BEGINNING = "beginning.safetensors"  # the policy that it begins with, if that is another run's
ENCODER = "encoder.safetensors"
EPISODES = "episodes.csv"
EVALUATIONS = "evaluations.csv"
INFOS = "infos.csv"  # where the environment tells numbers
_BEFORE = "progress", "error.txt", "tensorboard"  # of a run that has just begun
_TABLES = EPISODES, EVALUATIONS, INFOS
OWN = (RUN, CHECKPOINT, BEGINNING, ENCODER, *_TABLES, *_BEFORE)  # see `make_folder`
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


class PolicyHeader(Document, frozen=True, kw_only=True):
    """The header of a policy's file."""

    format = "jbrep policy"
    format_version = 5

    settings: RunSettings  # of the run
    encoder: dict[str, Any] | None  # the header of its encoder; None if that is code
    run: Line  # what the run is called
    step: Annotated[int, Meta(ge=0, le=MAX_STEPS)]  # of training
    finished: bool  # whether training was over


class Episode(NamedTuple):
    """An episode of training."""

    step: int  # of training, over all environments, at its end
    env: int  # its number
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
    """
    return read_rows(folder / EVALUATIONS, Evaluation, read_run(folder).tables[EVALUATIONS])


def read_infos(folder: Path) -> list[Info]:
    """The numbers of a run's evaluations, to the last bit; nothing where none are told."""
    sha256 = read_run(folder).tables.get(INFOS)
    return read_rows(folder / INFOS, Info, sha256) if sha256 else []


def last_infos(infos: Sequence[Info], evaluations: Sequence[Evaluation]) -> dict[str, list[float]]:
    """The numbers of the last evaluation's episodes, by name."""
    own = [{row.name: row.value} for row in infos if row.step == evaluations[-1].step]
    return by_name(own)


def last_returns(evaluations: Sequence[Evaluation]) -> list[float]:
    """The returns of the last evaluation; none of a policy that was never played."""
    return [row.episode_return for row in evaluations if row.step == evaluations[-1].step]


def read_run(folder: Path) -> RunRecord:
    """What run.json says of a run that has ended."""
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no finished run in {folder}: {RUN} is missing")
    return read_document(path, RunRecord)


def read_finished(folder: Path) -> tuple[RunRecord, str]:
    """The same of a run that has ended well, and the SHA-256 of its policy's file."""
    run = read_run(folder)
    if run.policy_sha256 is None:
        raise InputError(f"the run in {folder} {run.status}: it has no policy")
    return run, run.policy_sha256
