"""A run's folder: what a run leaves there, written and read."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec
from msgspec import Meta

from jbrep.envs.infos import by_name
from jbrep.envs.task import Id, Task, changed_parts
from jbrep.errors import DamageError, InputError, differences
from jbrep.records import container
from jbrep.records.commit import Commits
from jbrep.records.document import Document, read_document
from jbrep.records.record import Version, to_plain
from jbrep.records.storage import exists
from jbrep.records.tables import read_rows, write_csv
from jbrep.rl.presets import LINEAR, Hyperparameters
from jbrep.rl.settings import (
    CLASSES,
    MAX_EPISODES,
    MAX_STEPS,
    Episodes,
    LearnerName,
    Line,
    Name,
    Seed,
    Sha256,
    Steps,
    TrainingSettings,
)

POLICY_SUFFIX = ".safetensors"
RUN = "run.json"  # written last: its presence means that the run has ended
POLICY = "policy.safetensors"
POLICY_ZIP = "policy.zip"  # the same for stable-baselines3; jbrep doesn't read it
CHECKPOINT = "checkpoint.safetensors"  # until the run ends
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
_Algorithm = Annotated[
    str,
    Meta(pattern=rf"\A({'|'.join(CLASSES)})\Z", title=f"one of {', '.join(CLASSES)}"),
]


class SharedSettings(TrainingSettings, frozen=True, kw_only=True):
    """All settings that runs of one task, learner and representation share."""

    task: Id  # its name
    environment: Task
    algorithm: _Algorithm
    preset: Name
    overrides: Mapping[str, Any]  # what is set differently from the preset
    learner: LearnerName  # what tables call the algorithm with its settings
    hyperparameters: Hyperparameters  # the preset's, overridden
    representation: Name  # what tables call that which the agent observes
    encoder_code: Line | None  # module:Class, if it is code that no file can hold
    evaluate_every: Steps
    final_episodes: Episodes
    trainer: Literal["cohort", "sb3"]
    device: Literal["cpu", "cuda"]

    def check(self) -> None:
        """As for `Record`."""
        if self.environment.name != self.task:
            raise InputError(f"task is {self.task}, but environment is of {self.environment.name}")
        if self.final_episodes < self.evaluation_episodes:
            raise InputError(
                f"final_episodes is {self.final_episodes}: it must be as many as "
                f"evaluation_episodes, {self.evaluation_episodes}, or more"
            )

    @property
    def label(self) -> str:
        """What runs of other seeds have, too: TASK/LEARNER/REPRESENTATION."""
        return f"{self.task}/{self.learner}/{self.representation}"


class RunSettings(SharedSettings, frozen=True, kw_only=True):
    """All settings of a run; together with versions they decide every number, on one kind of CPU.

    Attributes:
        encoder: its fingerprint.
        encoder_seed: that the encoder was made with, if each run has its own.
        begin_from: SHA-256 of the policy of another run that this one begins with, if it does.
        registration: SHA-256 of that of its study, if that is registered.
    """

    seed: Seed
    encoder: Sha256
    encoder_seed: Seed | None
    begin_from: Sha256 | None = msgspec.field(name="from")
    registration: Sha256 | None

    @property
    def name(self) -> str:
        """The label with the seed: face_direction/sac-modern/dae-8/seed-0."""
        return f"{self.label}/seed-{self.seed}"

    def is_evaluation_due(self, step: int, keep_checkpoint: bool = False) -> bool:
        """Whether the policy is to be evaluated after so many steps, which aren't all.

        Where the run is kept, to go on later, they may be: the last evaluation comes after it.
        """
        at_once = self.control_steps(self.hyperparameters.num_envs)
        return step % self.evaluate_every < at_once and (keep_checkpoint or step < self.steps)

    @property
    def schedules(self) -> list[str]:
        """The names of what changes from a run's first step to its last."""
        chosen = self.hyperparameters.algorithm_kwargs.items()
        return [name for name, value in chosen if str(value).startswith(LINEAR)]

    def is_extended_by(self, longer: "RunSettings") -> bool:
        """Whether `longer` differs in having more steps alone, so that it may go on from here."""
        return self.steps < longer.steps and not self.replace(steps=longer.steps).differing(longer)

    @property
    def agent_steps(self) -> int:
        """Of training, as its agent counts them."""
        return self.hyperparameters.agent_steps(self.steps)

    def control_steps(self, agent_steps: int) -> int:
        """An agent's steps as runs count them: each for all control steps that hold its action."""
        return agent_steps * self.hyperparameters.action_repeat

    @property
    def episode_steps(self) -> int:
        """That an agent takes in the longest episode."""
        return self.hyperparameters.agent_steps(self.environment.max_episode_steps)

    def differing(self, wanted: "RunSettings") -> str:
        """How they differ from those of the run at hand, for a message; empty if they don't."""
        if changed := changed_parts(self.environment, wanted.environment):
            return f"{self.task} as it was before {changed} changed"
        return differences(_flat(self), _flat(wanted))


def _flat(settings: RunSettings) -> dict[str, Any]:
    """Settings with those of the environment and the hyperparameters among them.

    What is learned, by what and from what comes first.
    """
    own = to_plain(settings)
    parts = own.pop("environment"), own.pop("hyperparameters")
    first = {name: own[name] for name in ("task", "algorithm", "representation")}
    first["domain"] = parts[0]["domain"] = str(settings.environment.domain or "none")
    return {**first, **own, **parts[0], **parts[1]}


class RunRecord(Document, frozen=True, kw_only=True):
    """run.json: a run that has ended."""

    format = "jbrep run"
    format_version = 5
    max_bytes = 1 << 22

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
        """As for `Record`."""
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
    format_version = 4

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
    format_version = 1

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
    """Make sure that a folder isn't of a run that has only just begun.

    Raises:
        InputError: it is.
    """
    if exists(folder / ENCODER) and not is_run(folder):
        raise InputError(f"the run in {folder} has no {CHECKPOINT} yet, {SOON}")


def runs_below(folder: Path) -> list[Path]:
    """The folders of the runs below a folder that have finished or failed, in order."""
    return sorted(file.parent for file in folder.rglob(RUN))


def is_policy_file(path: Path) -> bool:
    """Whether this is a policy's file as `jbrep.rl.policy_file` writes it."""
    return path.suffix == POLICY_SUFFIX and container.format_of(path) == PolicyHeader.format


def read_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run: ascending steps, each with the same episodes from 0.

    The last one may have more of them.

    Raises:
        InputError: as `read_run`, or the table is missing.
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


def write_infos(folder: Path, rows: Sequence[Info]) -> str:
    """Write the numbers of a run's evaluations, to the last bit; returns the file's SHA-256.

    Raises:
        InputError: it can't be written.
    """
    return write_csv(folder / INFOS, Info._fields, rows)


def read_infos(folder: Path) -> list[Info]:
    """What `write_infos` wrote; nothing where the environment tells no numbers.

    Raises:
        InputError: as `read_run`, or the table is missing.
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
        InputError: there is none, or it has another version of the format.
        DamageError: it is damaged or something else.
    """
    path = folder / RUN
    if not exists(path):
        raise InputError(f"no finished run in {folder}: {RUN} is missing")
    return read_document(path, RunRecord)


def read_finished(folder: Path) -> tuple[RunRecord, str]:
    """The same of a run that has ended well, and the SHA-256 of its policy's file.

    Raises:
        InputError: as `read_run`, or the run failed.
        DamageError: as `read_run`.
    """
    run = read_run(folder)
    if run.policy_sha256 is None:
        raise InputError(f"the run in {folder} {run.status}: it has no policy")
    return run, run.policy_sha256
