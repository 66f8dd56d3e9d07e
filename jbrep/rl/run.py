"""What a training run is: task, learner, representation, seed, and how it is trained."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec import UNSET

from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.description import as_task
from jbrep.envs.names import is_code
from jbrep.envs.task import Task
from jbrep.records.record import Sha256, to_plain
from jbrep.rl.learner import Learner
from jbrep.rl.policy import policy_to_begin_with
from jbrep.rl.presets import usual_preset
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_EPISODES, Name, Seed, TrainingSettings
from jbrep.training.trainer import get_device, single_torch_thread

# where a run doesn't say: evaluations before the last, steps between them, and how many times as
# many episodes the last has
_EVALUATIONS, _APART, _FINAL = 10, 10_000, 10


class Run(TrainingSettings, frozen=True, kw_only=True):
    """What to train.

    Attributes:
        task: what is learned.
        learner: the algorithm with its hyperparameters.
        encoder: through which the agent observes: a name or file, code, or a user's own encoder,
            as `jbrep.encoders.find` takes it.
        seed: of agent and episodes.
        representation: what tables call it that the agent observes; the encoder's own name by
            default.
        encoder_seed: that the encoder was made with, if each run has its own.
        begin_from: the folder of a finished run, whose policy this one begins with.
        registration: SHA-256 of that of its study, if that is registered.
        one_robot: whether there is one instance of the environment, as of a robot that exists once.
    """

    task: Task
    learner: Learner
    encoder: Any = FULL
    seed: Seed = 0
    representation: Name | None = None
    encoder_seed: Seed | None = None
    begin_from: str = ""
    registration: Sha256 | None = None
    one_robot: bool = False

    @classmethod
    def of(
        cls,
        task: Task | str,
        algorithm: str = "sac",
        preset: str = "",
        overrides: Mapping[str, Any] = {},
        **others: Any,
    ) -> "Run":
        """A run of a task with an algorithm.

        Args:
            task: itself, or its name.
            algorithm: one of stable-baselines3's, such as sac.
            preset: its hyperparameters: paper, modern, wide, or a TOML file; if empty, that which
                serves a newcomer best, wide or modern.
            overrides: hyperparameters that are set differently, as with --set.
            others: fields of a run.
        """
        learner = Learner.given(algorithm, preset or usual_preset(algorithm), overrides)
        return cls(task=as_task(task), learner=learner, **others)

    def find_encoder(self) -> BaseEncoder:
        """The encoder."""
        with single_torch_thread():  # as in training, so that a module computes the same bits
            return find(self.encoder, self.task)

    def settings(self, encoder: BaseEncoder) -> RunSettings:
        """All settings that two equal runs share.

        Args:
            encoder: what `find_encoder` returns.
        """
        is_kept_as_code = is_code(self.encoder) and not isinstance(encoder, Encoder)
        shared = to_plain(self.training_settings) | {
            "device": get_device(self.device).type,
            "evaluate_every": self.evaluate_every or max(self.steps // _EVALUATIONS, _APART),
            "final_episodes": self.final_episodes
            or min(_FINAL * self.evaluation_episodes, MAX_EPISODES),
        }
        settings = RunSettings(
            task=self.task.name,
            environment=self.task,
            algorithm=self.learner.algorithm,
            preset=self.learner.preset,
            overrides=self.learner.overrides,
            learner=self.learner.name,
            hyperparameters=self.learner.hyperparameters,
            representation=self.representation or encoder.name,
            encoder=encoder.fingerprint,
            encoder_code=str(self.encoder) if is_kept_as_code else None,
            encoder_seed=self.encoder_seed,
            seed=self.seed,
            begin_from=None,
            registration=self.registration,
            one_robot=self.one_robot or UNSET,
            **shared,
        )
        if not self.begin_from:
            return settings
        sha256 = policy_to_begin_with(Path(self.begin_from), settings, encoder.latent_size)
        return settings.replace(begin_from=sha256)
