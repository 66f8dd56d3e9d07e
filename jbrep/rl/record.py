"""What a run's folder says of it: all settings that decide it, and run.json at its end."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from jbrep.envs.task import Id, Task
from jbrep.errors import InputError, differences
from jbrep.records.commit import Commits
from jbrep.records.document import Document
from jbrep.records.record import to_plain
from jbrep.rl.names import CLASSES
from jbrep.rl.presets import Hyperparameters
from jbrep.rl.settings import (
    MAX_STEPS,
    Episodes,
    LearnerName,
    Line,
    Name,
    Seed,
    Sha256,
    TrainingSettings,
)

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

    def is_evaluation_due(self, step: int, lanes: int) -> bool:
        """Whether the policy is to be evaluated after so many steps, which aren't all."""
        return step % self.evaluate_every < lanes and step < self.steps

    def episodes_at(self, step: int) -> int:
        """Of the evaluation after so many steps."""
        return self.final_episodes if step >= self.steps else self.evaluation_episodes

    @property
    def physics_threads(self) -> int | None:
        """Threads that step the robots: one where each core has a process, else all (None)."""
        return 1 if self.device == "cpu" else None

    def differing(self, wanted: "RunSettings") -> str:
        """How they differ from those of the run at hand, for a message; empty if they don't."""
        return differences(_flat(self), _flat(wanted))


def _flat(settings: RunSettings) -> dict[str, Any]:
    """Settings with those of the environment and the hyperparameters among them.

    What is learned, by what and from what comes first.
    """
    own = to_plain(settings)
    first = {name: own[name] for name in ("task", "algorithm", "representation")}
    return {**first, **own, **own.pop("environment"), **own.pop("hyperparameters")}


class RunRecord(Document, frozen=True, kw_only=True):
    """run.json: a run that has ended."""

    format = "jbrep run"
    format_version = 3
    max_bytes = 1 << 22

    status: Literal["finished", "failed"]
    reason: Line | None  # why it failed
    settings: RunSettings
    latent_size: Annotated[int, Meta(ge=1, le=1 << 20)]
    steps: Annotated[int, Meta(ge=0, le=MAX_STEPS)]
    seconds: Annotated[float, Meta(ge=0, le=1e12)]
    versions: Mapping[Line, Line]  # by package
    commits: Commits
    cpu: Line
    policy_sha256: Sha256 | None  # of its policy's file; null if it failed

    def check(self) -> None:
        """As for `Record`."""
        if (self.status == FINISHED) != (self.policy_sha256 is not None):
            raise InputError(f"it has {self.status}, but policy_sha256 is {self.policy_sha256}")


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
    format_version = 2

    settings: RunSettings
    encoder: dict[str, Any] | None
    run: Line
    step: Annotated[int, Meta(ge=0, le=MAX_STEPS)]
    finished: bool
