"""One training run: task, representation, algorithm, seed."""

import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from jbrep.encoders import FULL, Encoder, find, save
from jbrep.encoders.code import is_code
from jbrep.encoders.own import as_file
from jbrep.envs.checks import NonFiniteActionError
from jbrep.envs.description import as_task
from jbrep.envs.encoding import BaseEncoder
from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.envs.names import environment_versions
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.files.commit import commits
from jbrep.files.lock import exclusive
from jbrep.files.storage import exists, make_folder, write_whole
from jbrep.rl.agent import Evaluator, make_agent, make_env, training_seed, unchecked_distributions
from jbrep.rl.beginning import begin, policy_to_begin_with
from jbrep.rl.checkpoint import Checkpointer
from jbrep.rl.fields import MAX_EVALUATION_EPISODES, MAX_LINE, MAX_SEED, MAX_STEPS, NAME
from jbrep.rl.files import (
    CHECKPOINT,
    ENCODER,
    EPISODES,
    EVALUATIONS,
    FAILED,
    FINISHED,
    POLICY,
    RUN,
    Episode,
    Evaluation,
    differing,
    read_run,
    write_rows,
    write_run,
)
from jbrep.rl.learner import Learner, is_file
from jbrep.rl.policy_file import policy_zip
from jbrep.rl.presets import Preset
from jbrep.rl.recorder import DivergedError, History, Recorder, Scalars, Watch
from jbrep.rl.settings import used_settings
from jbrep.training.trainer import single_torch_thread

_PACKAGES = ("jbrep", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")
_LIMITS = {
    "steps": MAX_STEPS,
    "evaluate_every": MAX_STEPS,
    "evaluation_episodes": MAX_EVALUATION_EPISODES,
}


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
    representation: str = ""  # what tables call it; the encoder's own name by default
    encoder_seed: int | None = None  # that the encoder was made with, if each run has its own
    begin_from: str = ""  # the folder of a finished run, whose policy this one begins with

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", as_task(self.task))
        if is_file(self.preset):
            for name, value in self._learner.run_settings.items():
                object.__setattr__(self, name, value)
        for name, limit in _LIMITS.items():
            if not 1 <= getattr(self, name) <= limit:
                words = name.replace("_", " ")
                raise InputError(
                    f"{words} is {getattr(self, name)}: it must be between 1 and {limit:,}"
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
        is_kept_as_code = is_code(self.encoder) and not isinstance(encoder, Encoder)
        settings = {
            "task": self.task.name,
            "environment": self.task.as_json(),
            "algorithm": self.algorithm,
            "preset": self.preset,
            "overrides": self.settings,
            "learner": self._learner.name,
            **asdict(self.used),
            "representation": self.representation or encoder.representation,
            "encoder": encoder.fingerprint,
            "encoder_code": str(self.encoder) if is_kept_as_code else None,
            "encoder_seed": self.encoder_seed,
            "seed": self.seed,
            "steps": self.steps,
            "evaluate_every": self.evaluate_every,
            "evaluation_episodes": self.evaluation_episodes,
            "from": None,
        }
        if self.begin_from:
            folder = Path(self.begin_from)
            settings["from"] = policy_to_begin_with(folder, plain(settings), encoder.latent_size)
        return settings


def train(
    run: Run,
    folder: Path,
    watch: Watch = lambda step, mean: None,
    save_every: float = 60,
    stop: Callable[[], bool] = lambda: False,
    writers: Sequence[KVWriter] = (),
) -> dict[str, Any]:
    """Train an agent and write its folder, unless the run has ended already.

    A run that was killed or stopped resumes from its checkpoint, to the same bits.

    Args:
        run: what to train.
        folder: for this run alone.
        watch: called with the steps so far and the mean return of the last evaluation.
        save_every: seconds between checkpoints.
        stop: asked before each rollout; once it is true, the run writes a checkpoint and stops.
        writers: of stable-baselines3's logger, that get what TensorBoard gets.

    Returns:
        The contents of run.json.

    Raises:
        InputError: as `Run.check`; or the folder holds another run, or is in use.
        StoppedError: `stop` was true.
    """
    encoder = run.find_encoder()
    settings = plain(run.describe(encoder))
    if ended := _read_ended(folder, settings):
        return ended
    make_folder(folder)
    with exclusive(folder), single_torch_thread():
        return _read_ended(folder, settings) or _train(
            run, encoder, settings, folder, watch, save_every, stop, writers
        )


def read_result(run: Run, folder: Path) -> dict[str, Any] | None:
    """The contents of run.json; None if the run hasn't ended.

    Raises:
        InputError: as `Run.check`, or the folder holds another run.
    """
    encoder = run.find_encoder()
    return _read_ended(folder, plain(run.describe(encoder)))


def plain(value: Any) -> Any:
    """The value as JSON gives it back: lists for tuples."""
    if isinstance(value, Mapping):
        return {name: plain(v) for name, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def _read_ended(folder: Path, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The contents of run.json, if the run has ended."""
    if not exists(folder / RUN):
        return None
    result = read_run(folder)
    if others := differing(result["settings"], settings):
        raise InputError(f"{folder} holds another run: {others}; choose another folder")
    return result


def _train(
    run: Run,
    encoder: BaseEncoder,
    settings: dict[str, Any],
    folder: Path,
    watch: Watch,
    save_every: float,
    stop: Callable[[], bool],
    writers: Sequence[KVWriter],
) -> dict[str, Any]:
    """The run, from its start or its checkpoint to its end."""
    versions = environment_versions(run.task.id) | {name: version(name) for name in _PACKAGES}
    history = History()
    checkpointer = Checkpointer(
        folder / CHECKPOINT, {**settings, **versions}, history, save_every, stop
    )
    if isinstance(encoder, Encoder):  # now that no checkpoint of another run is there
        save(encoder, folder / ENCODER)

    preset = run.used
    seed = training_seed(run.seed)
    env = make_env(run.task, preset.num_envs, seed, encoder, preset.normalize)
    agent = make_agent(run.algorithm, preset, env, run.seed)
    env.seed(seed)  # stable-baselines3 gave it the agent's, which lanes of other runs share
    if run.begin_from:
        begin(agent, Path(run.begin_from), settings["from"], folder)
    agent.set_logger(Logger(None, [Scalars(folder / "tensorboard", history.first_step), *writers]))

    evaluator = Evaluator(run.task, encoder, run.evaluation_episodes)
    recorder = Recorder(history, evaluator, run.evaluate_every, watch)
    failure = _learn(agent, run.steps, [recorder, checkpointer])

    result = {
        "status": FAILED if failure else FINISHED,
        **({"reason": failure} if failure else {}),
        "settings": settings,
        "latent_size": encoder.latent_size,
        "steps": agent.num_timesteps,
        "seconds": history.seconds,
        "versions": versions,
        "commits": dict(commits()),
        "cpu": _cpu(),
    }
    write_rows(folder / EPISODES, history.episodes, Episode)
    write_rows(folder / EVALUATIONS, history.evaluations, Evaluation)
    if not failure:
        policy = policy_zip(agent)
        write_whole(folder / POLICY, policy)
        result["policy_sha256"] = hashlib.sha256(policy).hexdigest()
    write_run(folder, result)  # last: the run has ended where it exists
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return result


def _learn(agent: BaseAlgorithm, steps: int, callbacks: Sequence[BaseCallback]) -> str:
    """Train up to that step; why training failed, or nothing."""
    try:
        with unchecked_distributions():
            agent.learn(steps, callback=[*callbacks])
    except (DivergedError, EnvironmentFailedError) as error:
        failure = _one_line(str(error))
    except NonFiniteActionError:
        failure = "the policy's actions are not finite"
    else:
        return ""
    finally:
        agent.logger.close()
    return f"{failure} after {agent.num_timesteps:,} steps"


def _one_line(text: str) -> str:
    """Text as run.json may hold it, whatever an environment says."""
    return "".join(c if c.isprintable() else "?" for c in text)[: MAX_LINE // 2]


def _cpu() -> str:
    """The processor's name, where the system tells it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
