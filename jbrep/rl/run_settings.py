"""All settings of a run."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, UnsetType

from jbrep.envs.task import Id, Task
from jbrep.errors import differences
from jbrep.records.record import Sha256, pattern, to_plain
from jbrep.rl.presets import ALGORITHMS, LINEAR, Hyperparameters, learns_from
from jbrep.rl.settings import (
    CloneSettings,
    Episodes,
    LearnerName,
    Line,
    Name,
    Seed,
    Steps,
    TrainingSettings,
)

_Algorithm = Annotated[
    str, pattern(rf"\A({'|'.join(ALGORITHMS)})\Z", f"one of {', '.join(ALGORITHMS)}")
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
    device: Literal["cpu", "cuda"]

    @property
    def label(self) -> str:
        """What runs of other seeds have, too: TASK/LEARNER/REPRESENTATION."""
        return f"{self.task}/{self.learner}/{self.representation}"


class Cloned(CloneSettings, frozen=True, kw_only=True):
    """How a policy was learned from a data set alone; its run's steps are gradient steps."""

    data: Sha256  # the data set's fingerprint


class RunSettings(SharedSettings, frozen=True, kw_only=True):
    """All of a run; together with versions they decide every number, on one kind of CPU."""

    seed: Seed
    encoder: Sha256  # its fingerprint
    encoder_seed: Seed | None  # that the encoder was made with, if each run has its own
    # SHA-256 of the policy of another run that this one begins with, if it does
    begin_from: Sha256 | None = msgspec.field(name="from")
    registration: Sha256 | None  # SHA-256 of that of its study, if that is registered
    # whether it was trained and evaluated in one instance of its environment; evaluations then wait
    # for the end of an episode of training
    one_robot: Literal[True] | UnsetType = UNSET
    cloned: Cloned | UnsetType = UNSET  # how it was learned from data, without an environment

    @property
    def name(self) -> str:
        """The label with the seed: face_direction/sac-modern/dae-8/seed-0."""
        return f"{self.label}/seed-{self.seed}"

    @property
    def chunk(self) -> int:
        """How many actions the policy chooses at once."""
        return self.cloned.chunk if self.cloned else 1

    def is_evaluation_due(self, step: int, keep_checkpoint: bool = False) -> bool:
        """Whether the policy is to be evaluated after so many steps.

        The last step is left to the final evaluation, unless the run is kept to go on later: a
        longer run would be evaluated there.
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

    def beginning_as(self, before: "RunSettings") -> "RunSettings":
        """The same with the warm-up of another run, if a share of the steps decides it."""
        chosen, first = self.hyperparameters, before.hyperparameters.algorithm_kwargs
        if chosen.warm_up is UNSET or "learning_starts" not in first:
            return self
        return self.replace(hyperparameters=chosen.learning_from(first["learning_starts"]))

    @property
    def agent_steps(self) -> int:
        """Of training, as its agent counts them."""
        return self.hyperparameters.agent_steps(self.steps)

    @property
    def learns_from(self) -> int:
        """The step from which its agent learns; until then it acts at random."""
        return learns_from(self.algorithm, self.hyperparameters)

    def control_steps(self, agent_steps: int) -> int:
        """An agent's steps as runs count them: each for all control steps that hold its action."""
        return agent_steps * self.hyperparameters.action_repeat

    @property
    def episode_steps(self) -> int:
        """That an agent takes in the longest episode."""
        return self.hyperparameters.agent_steps(self.environment.max_episode_steps)

    def differing(self, wanted: "RunSettings") -> str:
        """How they differ from those of the run at hand, for a message; empty if they don't."""
        return differences(_flat(self), _flat(wanted))


def _flat(settings: RunSettings) -> dict[str, Any]:
    """Settings with those of the environment and the hyperparameters among them.

    What is learned, by what and from what comes first.
    """
    own = to_plain(settings)
    parts = own.pop("environment"), own.pop("hyperparameters")
    first = {name: own[name] for name in ("task", "algorithm", "representation")}
    own["one_robot"] = settings.one_robot is True
    first["domain"] = parts[0]["domain"] = str(settings.environment.domain or "none")
    return {**first, **own, **parts[0], **parts[1]}
