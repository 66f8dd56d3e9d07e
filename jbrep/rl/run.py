"""One training run: task, representation, algorithm, seed."""

import hashlib
import io
import platform
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import Logger

from jbrep.dae.training import single_torch_thread
from jbrep.encoders import FULL, Encoder, find, save
from jbrep.encoders.file import fingerprint
from jbrep.errors import InputError, differences
from jbrep.files.lock import exclusive
from jbrep.files.storage import exists, make_folder, write_whole
from jbrep.jitterbug.tasks import get_task
from jbrep.rl import checkpoint
from jbrep.rl.agent import Evaluator, make_agent, make_env, training_seed
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
    read_run,
    write_rows,
    write_run,
)
from jbrep.rl.presets import get_preset
from jbrep.rl.recorder import NotFiniteError, Recorder, Scalars, Watch

_PACKAGES = ("jbrep", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")
_MOST_SEED = 1 << 31
_NOT_FINITE = ("found invalid values", "actions are not finite")


@dataclass(frozen=True, kw_only=True)
class Run:
    """What to train; together with the versions it decides every number, on one kind of CPU.

    Raises:
        InputError: a number out of range.
    """

    task: str
    algorithm: str = "sac"
    preset: str = "paper"
    encoder: str = "identity"  # a file, or a name that ships; identity is the full observation
    seed: int = 0
    steps: int = 100_000
    evaluate_every: int = 10_000  # steps
    evaluation_episodes: int = 10
    episode_steps: int = 1000

    def __post_init__(self) -> None:
        for name in ("steps", "evaluate_every", "evaluation_episodes"):
            if getattr(self, name) < 1:
                said = name.replace("_", " ")
                raise InputError(f"{said} is {getattr(self, name)}: a number from 1 is needed")
        if not 0 <= self.seed < _MOST_SEED:
            raise InputError(f"the seed is {self.seed}: from 0 to {_MOST_SEED - 1} is needed")

    def check(self) -> None:
        """Make sure that it can be run.

        Raises:
            InputError: an unknown task, algorithm or preset, or an encoder that can't be used.
        """
        self.describe(find(self.encoder, get_task(self.task).name))

    def describe(self, encoder: Encoder) -> dict[str, Any]:
        """All that makes two runs the same, as plain JSON.

        Raises:
            InputError: as `check`.
        """
        return {
            "task": get_task(self.task).name,
            "algorithm": self.algorithm,
            "preset": self.preset,
            **asdict(get_preset(self.preset, self.algorithm)),
            "representation": FULL if encoder.name == "identity" else encoder.name,
            "encoder": fingerprint(encoder),
            "seed": self.seed,
            "steps": self.steps,
            "evaluate_every": self.evaluate_every,
            "evaluation_episodes": self.evaluation_episodes,
        }


def train(
    run: Run, folder: Path, watch: Watch = lambda step, mean: None, save_every: float = 60
) -> dict[str, Any]:
    """Train an agent and write its folder, unless the run is over already.

    A run that was killed goes on from its checkpoint, to the same bits.

    Args:
        run: what to train.
        folder: for this run alone.
        watch: is told the steps so far, and the mean return of the last evaluation.
        save_every: seconds from one checkpoint to the next.

    Returns:
        What run.json holds.

    Raises:
        InputError: as `Run.check`, or the folder holds another run, or another process writes it.
    """
    encoder = find(run.encoder, get_task(run.task).name)
    settings = plain(run.describe(encoder))
    if exists(folder / RUN):
        return _check_same(folder, settings)
    make_folder(folder)
    with exclusive(folder), single_torch_thread():
        save(encoder, folder / ENCODER)
        return _Training(run, encoder, settings, folder, watch, save_every).finish()


def plain(value: Any) -> Any:
    """As JSON gives it back: lists for tuples."""
    if isinstance(value, Mapping):
        return {name: plain(v) for name, v in value.items()}
    return [plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def _check_same(folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    there = read_run(folder)
    if differing := differences(there["settings"], settings):
        raise InputError(f"{folder} holds another run: {differing}; choose another folder")
    return there


class _Training:
    """A run under way."""

    def __init__(
        self,
        run: Run,
        encoder: Encoder,
        settings: dict[str, Any],
        folder: Path,
        watch: Watch,
        save_every: float,
    ):
        self._settings, self._folder, self._steps = settings, folder, run.steps
        self._versions = {name: version(name) for name in _PACKAGES}
        self._before, self._began = 0.0, time.monotonic()  # seconds of earlier processes
        preset = get_preset(run.preset, run.algorithm)
        env = make_env(run.task, preset.num_envs, training_seed(run.seed), encoder)
        self._agent = make_agent(run.algorithm, preset, env, run.seed)
        evaluator = Evaluator(run.task, encoder, run.evaluation_episodes)
        self._recorder = Recorder(
            evaluator, run.evaluate_every, self._begin, watch, self._save, save_every
        )

    @property
    def _checkpoint(self) -> Path:
        return self._folder / CHECKPOINT

    @property
    def _identity(self) -> dict[str, Any]:
        return {**self._settings, **self._versions}

    @property
    def _seconds(self) -> float:
        return round(self._before + time.monotonic() - self._began, 1)

    def finish(self) -> dict[str, Any]:
        """Learn to the end, and write what came of it."""
        problem = self._learn()
        write_rows(self._folder / EPISODES, self._recorder.episodes, Episode)
        write_rows(self._folder / EVALUATIONS, self._recorder.evaluations, Evaluation)
        result = {
            "status": FAILED if problem else FINISHED,
            **({"reason": problem} if problem else {}),
            "settings": self._settings,
            "steps": self._agent.num_timesteps,
            "seconds": self._seconds,
            "versions": self._versions,
            "cpu": _cpu(),
        }
        if not problem:
            content = io.BytesIO()
            self._agent.save(content)
            write_whole(self._folder / POLICY, content.getvalue())
            result["policy_sha256"] = hashlib.sha256(content.getvalue()).hexdigest()
        write_run(self._folder, result)
        self._checkpoint.unlink(missing_ok=True)
        return result

    def _learn(self) -> str:
        """Learn to the end; what stopped it, if something did."""
        agent = self._agent
        try:
            agent.learn(self._steps, callback=self._recorder)
        except NotFiniteError as error:
            problem = str(error)
        except ValueError as error:  # torch's distributions refuse NaN, as the environment does
            if not any(words in str(error) for words in _NOT_FINITE):
                raise
            problem = "the policy's actions are not finite"
        else:
            return ""
        finally:
            agent.logger.close()
        return f"{problem} after {agent.num_timesteps:,} steps"

    def _begin(self) -> None:
        """Go on from the checkpoint, if there is one."""
        if exists(self._checkpoint):
            record = checkpoint.restore(self._agent, self._identity, self._checkpoint)
            self._before = record.pop("seconds")
            self._recorder.resume(record)
        scalars = Scalars(self._folder / "tensorboard", self._agent.num_timesteps)
        self._agent.set_logger(Logger(None, [scalars]))

    def _save(self) -> None:
        record = {**self._recorder.record, "seconds": self._seconds}
        checkpoint.save(self._agent, record, self._identity, self._checkpoint)


def _cpu() -> str:
    """The processor's name, where the system tells it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
