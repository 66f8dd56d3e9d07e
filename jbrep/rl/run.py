"""What a training run is: task, representation, algorithm, seed."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.code import is_code
from jbrep.encoders.encoder import as_file
from jbrep.envs.description import as_task
from jbrep.envs.task import Task
from jbrep.errors import InputError, choose
from jbrep.records.record import to_plain
from jbrep.rl.beginning import policy_to_begin_with
from jbrep.rl.cohort.algorithm import check as check_settings
from jbrep.rl.fields import MAX_EVALUATION_EPISODES, MAX_SEED, MAX_STEPS, NAME
from jbrep.rl.learner import Learner, is_file
from jbrep.rl.names import COHORT, CPU, DEVICES, FLOAT32, PRECISIONS, TRAINERS, usual_trainer
from jbrep.rl.overrides import used_settings
from jbrep.rl.presets import Preset
from jbrep.training.trainer import get_device, single_torch_thread

_LIMITS = {
    "steps": MAX_STEPS,
    "evaluate_every": MAX_STEPS,
    "evaluation_episodes": MAX_EVALUATION_EPISODES,
    "final_episodes": MAX_EVALUATION_EPISODES,
}
_FINAL = 10  # times as many episodes as the other evaluations, if a run doesn't say how many


@dataclass(frozen=True, kw_only=True)
class Run:
    """What to train; together with the versions it decides every number, on one kind of CPU.

    Raises:
        InputError: a number out of range, or a name that can't be used.
    """

    task: Task  # or its name, which is then described
    algorithm: str = "sac"
    preset: str = "paper"  # or a preset file, which is read at once
    settings: Mapping[str, Any] = field(default_factory=dict)  # set differently from the preset
    learner: str = ""  # what tables call algorithm and settings; from their names by default
    encoder: Any = FULL  # a name or file, code, or a user's own encoder, as `find` takes it
    seed: int = 0
    steps: int = 100_000
    evaluate_every: int = 10_000  # steps
    evaluation_episodes: int = 10
    final_episodes: int = 0  # of the last evaluation; 0: ten times as many as of the others
    representation: str = ""  # what tables call it; the encoder's own name by default
    encoder_seed: int | None = None  # that the encoder was made with, if each run has its own
    begin_from: str = ""  # the folder of a finished run, whose policy this one begins with
    trainer: str = ""  # cohort or sb3; by default cohort, for the algorithms that it has
    precision: str = FLOAT32  # of products of matrices: float32 or bfloat16
    registration: str = ""  # SHA-256 of that of its study, if that is registered
    device: str = CPU  # of gradient steps: cpu, cuda, or auto, which is cuda if there is one

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", as_task(self.task))
        if is_file(self.preset):
            for name, value in self._learner.run_settings.items():
                object.__setattr__(self, name, value)
        object.__setattr__(self, "trainer", self.trainer or usual_trainer(self.algorithm))
        choose(self.trainer, TRAINERS, "trainer")
        choose(self.precision, PRECISIONS, "precision")
        object.__setattr__(self, "device", _device(self.device))
        if not self.final_episodes:
            final = min(_FINAL * self.evaluation_episodes, MAX_EVALUATION_EPISODES)
            object.__setattr__(self, "final_episodes", final)
        for name, limit in _LIMITS.items():
            if not 1 <= getattr(self, name) <= limit:
                words = name.replace("_", " ")
                raise InputError(
                    f"{words} is {getattr(self, name)}: it must be between 1 and {limit:,}"
                )
        if self.final_episodes < self.evaluation_episodes:
            raise InputError(
                f"final episodes are {self.final_episodes}: they must be as many as evaluation "
                f"episodes, {self.evaluation_episodes}, or more"
            )
        for name, seed in (("seed", self.seed), ("encoder seed", self.encoder_seed or 0)):
            if not 0 <= seed <= MAX_SEED:
                raise InputError(f"the {name} is {seed}: it must be between 0 and {MAX_SEED:,}")
        if self.representation and not NAME.allows(self.representation):
            raise InputError(
                f"the representation is {self.representation!r}: it must be {NAME.words}"
            )

    def check(self) -> None:
        """Check that the run can start.

        Raises:
            InputError: an unknown algorithm or preset, an unusable encoder, or a policy that this
                run can't begin with.
        """
        self.describe(self.find_encoder())

    def check_trainer(self) -> None:
        """Check that its trainer can train it.

        Raises:
            InputError: it can't, and another could.
        """
        if self.trainer == COHORT:
            check_settings(self.algorithm, self.used)
        elif self.trainer not in PRECISIONS[self.precision]:
            raise InputError(f"{self.trainer} has no {self.precision}: leave the precision out")
        elif self.device != CPU:
            raise InputError(f"{self.trainer} trains on the cpu here: leave the device out")

    def is_evaluation_due(self, step: int, lanes: int) -> bool:
        """Whether the policy is to be evaluated after so many steps, which aren't all."""
        return step % self.evaluate_every < lanes and step < self.steps

    def episodes_at(self, step: int) -> int:
        """Of the evaluation after so many steps."""
        return self.final_episodes if step >= self.steps else self.evaluation_episodes

    @property
    def physics_threads(self) -> int | None:
        """Threads that step the robots: one where each core has a process, else all (None)."""
        return 1 if self.device == CPU else None

    def find_encoder(self) -> BaseEncoder:
        """The encoder; a user's torch module as the file that is kept of it, if it can be.

        Raises:
            InputError: it can't be used.
        """
        with single_torch_thread():  # as in training, so that a module computes the same bits
            return as_file(find(self.encoder, self.task))

    @property
    def _learner(self) -> Learner:
        return Learner.given(self.algorithm, self.preset, self.settings, self.learner)

    @property
    def used(self) -> Preset:
        """All settings of the algorithm.

        Raises:
            InputError: an unknown algorithm, preset or setting, or a value that it can't have.
        """
        return used_settings(self.algorithm, self.preset, self.settings)

    def describe(self, encoder: BaseEncoder) -> dict[str, Any]:
        """All settings that two equal runs share, as plain JSON.

        Raises:
            InputError: as `check`.
        """
        self.check_trainer()
        get_device(self.device)  # which another machine may have had
        is_kept_as_code = is_code(self.encoder) and not isinstance(encoder, Encoder)
        settings = {
            "task": self.task.name,
            "environment": to_plain(self.task),
            "algorithm": self.algorithm,
            "preset": self.preset,
            "overrides": self.settings,
            "learner": self._learner.name,
            **asdict(self.used),
            "representation": self.representation or encoder.name,
            "encoder": encoder.fingerprint,
            "encoder_code": str(self.encoder) if is_kept_as_code else None,
            "encoder_seed": self.encoder_seed,
            "seed": self.seed,
            "steps": self.steps,
            "evaluate_every": self.evaluate_every,
            "evaluation_episodes": self.evaluation_episodes,
            "final_episodes": self.final_episodes,
            "from": None,
            "trainer": self.trainer,
            "precision": self.precision,
            "device": self.device,
            "registration": self.registration or None,
        }
        if self.begin_from:
            folder = Path(self.begin_from)
            settings["from"] = policy_to_begin_with(folder, plain(settings), encoder.latent_size)
        return settings


def _device(name: str) -> str:
    """The name of a device, which this machine need not have; for auto, of one that it has."""
    return name if name in DEVICES else str(get_device(name).type)


def plain(value: Any) -> Any:
    """The value as JSON gives it back: lists for tuples."""
    if isinstance(value, Mapping):
        return {name: plain(v) for name, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value
