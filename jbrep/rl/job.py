"""A run in its folder: how it begins, and how it ends."""

import hashlib
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from jbrep.encoders import Encoder, save
from jbrep.envs.infos import by_name
from jbrep.envs.lanes import EnvironmentFailedError, Lanes, lanes_at_once
from jbrep.envs.names import environment_versions
from jbrep.errors import InputError
from jbrep.machine import cores
from jbrep.records.commit import commits
from jbrep.records.storage import exists, read_file, write_whole
from jbrep.records.tables import write_csv, write_rows
from jbrep.rl.agent import Evaluator, action_repeat, restore_statistics, statistics_of
from jbrep.rl.checkpoint import CheckpointFile, History, run_settings
from jbrep.rl.files import (
    BEGINNING,
    CHECKPOINT,
    ENCODER,
    EPISODES,
    EVALUATIONS,
    FAILED,
    FINISHED,
    INFOS,
    POLICY,
    POLICY_ZIP,
    RUN,
    Episode,
    Evaluation,
    Info,
    RunRecord,
    is_run,
    read_run,
)
from jbrep.rl.policy_file import read
from jbrep.rl.policy_zip import policy_zip
from jbrep.rl.run import Run
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import CPU, MAX_LINE
from jbrep.rl.trained import Trained, fill_whole, pack_whole
from jbrep.text import printable

Ended = tuple["Job", RunRecord]
_PACKAGES = ("jbrep", "mujoco", "numpy", "sb3-contrib", "stable-baselines3", "torch")


def packages() -> dict[str, str]:
    """The versions of what every run is made with."""
    return {name: version(name) for name in _PACKAGES}


class Session(NamedTuple):
    """What goes on around training.

    Attributes:
        watch: called with a run and its steps so far.
        save_every: seconds between checkpoints, at least.
        stop: asked before each rollout; once it is true, checkpoints are written and training ends.
        writers: of stable-baselines3's logger, that get what TensorBoard gets.
        keep_checkpoint: whether a run that has ended keeps a checkpoint, from which it can go on.
    """

    watch: Callable[["Job", int], None] = lambda job, step: None
    save_every: float = 60
    stop: Callable[[], bool] = lambda: False
    writers: Sequence[KVWriter] = ()
    keep_checkpoint: bool = False


class Job:
    """A run, and the folder that is its alone.

    Attributes:
        run: what to train.
        folder: where; it need not exist yet.
        threads: that may step its robots; gradient steps take one. None: one, or all beside a GPU.
        retries: how often in a row an environment that fails is made anew.
        encoder: that the run sees its task through.
        settings: of the run, as run.json has them.
        history: what was recorded so far.
    """

    def __init__(
        self,
        run: Run,
        folder: Path,
        threads: int | None = None,
        retries: int = 0,
    ):
        self.run, self.folder, self.threads, self.retries = run, folder, threads, retries
        self.encoder = run.find_encoder()
        self.settings = self._going_on(self._as_begun(run.settings(self.encoder)))
        self.history = History()

    def anew(self) -> "Job":
        """The same with nothing recorded yet."""
        return Job(self.run, self.folder, self.threads, self.retries)

    def threads_for(self, lanes: int) -> int:
        """How many threads step so many of its robots; no bit depends on it."""
        alone = self.settings.device != CPU  # studies have a process for each core otherwise
        return min(self.threads or (cores() if alone else 1), lanes)

    @property
    def result(self) -> RunRecord | None:
        """The contents of run.json, if the run has ended."""
        if not exists(self.folder / RUN):
            return None
        result = read_run(self.folder)
        if result.settings.is_extended_by(self.settings):
            self._check_goes_on(result)
            return None
        if others := result.settings.differing(self.settings):
            raise InputError(f"{self.folder} holds another run: {others}; choose another folder")
        return result

    def _going_on(self, settings: RunSettings) -> RunSettings:
        """Settings with evaluations as far apart as before, where a run goes on or has gone on."""
        if self.run.evaluate_every or not is_run(self.folder):
            return settings
        before = run_settings(self.folder)
        same = settings.replace(evaluate_every=before.evaluate_every)
        goes_on = before.is_extended_by(same) or not before.differing(same)
        return same if goes_on else settings

    def _as_begun(self, settings: RunSettings) -> RunSettings:
        """Settings with the policy that a run began with, where its source has gone on since."""
        path = self.folder / BEGINNING
        if not settings.begin_from or not exists(path):
            return settings
        source = read_run(Path(self.run.begin_from)).settings
        has_gone_on = read(path).header.settings.is_extended_by(source)
        return settings.replace(begin_from=_sha256(path)) if has_gone_on else settings

    def _check_goes_on(self, before: RunRecord) -> None:
        """Make sure that a run with fewer steps can go on."""
        what = f"the run of {before.settings.steps:,} steps in {self.folder} can't go on"
        if before.status == FAILED:
            raise InputError(f"{what}: it failed; choose another folder")
        if schedules := before.settings.schedules:
            raise InputError(
                f"{what}: its {schedules[0]} has fallen to 0 already, where a longer run's "
                "hasn't; choose another folder"
            )
        if not exists(self.folder / CHECKPOINT):
            raise InputError(
                f"{what}: its {CHECKPOINT} is gone; choose another folder, perhaps with --from"
            )

    def check_can_go_on(self) -> None:
        """Make sure, before anything is played again, that a run that was stopped can go on."""
        if not self.run.task.reproducible and exists(self.folder / CHECKPOINT):
            raise InputError(
                f"{self.run.task.name} is not reproducible: the run in {self.folder} can't go on "
                "where it stopped, but its policy can be played (jbrep evaluate-policy) and "
                "exported; choose another folder"
            )

    def clear(self) -> None:
        """Remove what a run that has ended may have left, if it was killed at the very end."""
        if self.result:
            (self.folder / CHECKPOINT).unlink(missing_ok=True)

    @cached_property
    def versions(self) -> dict[str, str]:
        """What, with the settings, decides every number."""
        return environment_versions(self.run.task) | packages()

    @cached_property
    def checkpoint(self) -> CheckpointFile:
        """The run's snapshots."""
        path = self.folder / CHECKPOINT
        return CheckpointFile(path, self.settings, self.versions, self.history)

    def keep_encoder(self) -> None:
        """Write the encoder's file; do it when no checkpoint of another run is there."""
        if isinstance(self.encoder, Encoder):
            save(self.encoder, self.folder / ENCODER)

    def prepare(self, agent: BaseAlgorithm, writers: Sequence[KVWriter]) -> None:
        """Let an untrained agent begin as the run does, and log to TensorBoard and to writers.

        Raises:
            DamageError: that isn't what was written.
        """
        self.history.start()
        if sha256 := self.settings.begin_from:
            path = self.folder / BEGINNING
            if not exists(path) or _sha256(path) != sha256:
                source = read(Path(self.run.begin_from) / POLICY, sha256).path
                write_whole(path, read_file(source))
            policy = read(path, sha256)
            fill_whole(policy, agent.policy)
            restore_statistics(agent, policy.tensors, path)
        scalars = Scalars(self.folder / "tensorboard", self.history.first_step)
        agent.set_logger(_Logger(self.settings, [scalars, *writers]))

    @cached_property
    def evaluator(self) -> Evaluator:
        """What plays the run's evaluations."""
        return self._evaluator(None)

    def share(self, lanes: Lanes) -> None:
        """Evaluate in the lanes of training, if there is one robot."""
        if self.run.one_robot:
            self.evaluator = self._evaluator(lanes)

    def _evaluator(self, lanes: Lanes | None) -> Evaluator:
        task, episodes = self.run.task, self.run.evaluation_episodes
        threads = self.threads_for(episodes)
        lanes = lanes or lanes_at_once(task, episodes, threads, self.retries)
        return Evaluator(lanes, self.encoder, episodes)

    def is_evaluation_due(self, step: int, episode_ended: bool, keep_checkpoint: bool) -> bool:
        """Whether to evaluate after so many steps.

        Args:
            step: of training.
            episode_ended: whether an episode of training has just ended.
            keep_checkpoint: as for `RunSettings.is_evaluation_due`.
        """
        if not self.run.one_robot:
            return self.settings.is_evaluation_due(step, keep_checkpoint)
        every, last = self.settings.evaluate_every, self.history.evaluations[-1].step
        is_final = step >= self.settings.steps and not keep_checkpoint
        return episode_ended and not is_final and step // every > last // every

    def close(self) -> None:
        """Free what the evaluations hold."""
        if "evaluator" in vars(self):
            self.evaluator.close()
            del self.evaluator

    def final_evaluation(self, agent: BaseAlgorithm) -> None:
        """Evaluate a trained agent, in more episodes; see `evaluate`.

        This replaces an evaluation that was made after the last step as the run is kept to go on.
        """
        self.history.forget_from(self.settings.steps)
        self.evaluate(agent, self.settings.final_episodes)

    def evaluate(self, agent: BaseAlgorithm, episodes: int | None = None) -> None:
        """Play an agent's deterministic policy, and record and log the returns and infos.

        Raises:
            NonFiniteActionError, EnvironmentFailedError: as `Evaluator.outcome`.
        """
        step, logger = self.step_of(agent), agent.logger
        outcome = self.evaluator.outcome(agent, episodes)
        self.history.evaluated(step, outcome)
        logger.record("evaluation/mean_return", self.history.mean)
        for name, values in by_name(outcome.numbers).items():
            logger.record(f"evaluation/{name}", fmean(values))
        logger.dump(agent.num_timesteps)

    def step_of(self, agent: BaseAlgorithm) -> int:
        """Training steps so far, in control steps."""
        return self.settings.control_steps(agent.num_timesteps)

    def end(
        self, agent: BaseAlgorithm, failed: Exception | None, keep_checkpoint: bool
    ) -> RunRecord:
        """Write the run's files.

        Args:
            agent: trained; the policy of a run that failed isn't kept.
            failed: why; None if it didn't. Where a run went on after fewer steps, what it had left
                by then stays, and nothing is written.
            keep_checkpoint: whether the last checkpoint outlives the run.

        Returns:
            The contents of run.json; or what they would be.
        """
        folder, history = self.folder, self.history
        failure = "" if failed is None else str(failed)
        if failure and exists(folder / RUN):
            return self._record(agent, failure, read_run(folder).tables, b"")
        goes_on = keep_checkpoint and exists(folder / CHECKPOINT)
        if goes_on and isinstance(failed, EnvironmentFailedError):
            raise self._stopped_by(failed) from failed
        (folder / RUN).unlink(missing_ok=True)  # of fewer steps, before its files change
        parts = agent.policy, self.run.task, self.encoder, self.settings
        trained = Trained(*parts, None, statistics_of(agent), action_repeat(agent))
        policy = b"" if failure else pack_whole(trained)
        tables = {
            EPISODES: write_rows(folder / EPISODES, history.episodes, Episode),
            EVALUATIONS: write_rows(folder / EVALUATIONS, history.evaluations, Evaluation),
        }
        if history.infos:
            tables[INFOS] = write_csv(folder / INFOS, Info._fields, history.infos)
        if policy:
            write_whole(folder / POLICY, policy)
            write_whole(folder / POLICY_ZIP, policy_zip(agent, self.settings))
        result = self._record(agent, failure, tables, policy)
        result.write(folder / RUN)  # last: the run has ended where it exists
        return result

    def _stopped_by(self, failed: Exception) -> InputError:
        """The error that says what can be done with the last checkpoint."""
        goes_on = "the same command goes on from its last checkpoint"
        played = "its last checkpoint can be played (jbrep evaluate-policy) and exported"
        then = goes_on if self.run.task.reproducible else played
        return InputError(f"{failed}; of the run in {self.folder}, {then}")

    def _record(
        self, agent: BaseAlgorithm, failure: str, tables: Mapping[str, str], policy: bytes
    ) -> RunRecord:
        steps, told = self.step_of(agent), printable(failure)[: MAX_LINE // 2]
        return RunRecord(
            status=FAILED if failure else FINISHED,
            reason=f"{told} after {steps:,} steps" if failure else None,
            settings=self.settings,
            latent_size=self.encoder.latent_size,
            steps=steps,
            seconds=self.history.seconds,
            versions=self.versions,
            commits=commits(),
            cpu=_cpu(),
            tables=tables,
            policy_sha256=hashlib.sha256(policy).hexdigest() if policy else None,
        )


def _sha256(path: Path) -> str:
    return hashlib.sha256(read_file(path)).hexdigest()


def _cpu() -> str:
    """The processor's name, where the system tells it."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


class _Logger(Logger):
    """stable-baselines3's, that tells writers control steps instead of its agent's."""

    def __init__(self, settings: RunSettings, writers: list[KVWriter]):
        super().__init__(None, writers)
        self._settings = settings

    def dump(self, step: int = 0) -> None:
        """Write what was recorded, after so many steps of the agent."""
        super().dump(self._settings.control_steps(step))


class Scalars(TensorBoardOutputFormat):
    """TensorBoard's file after a step; later ones of an earlier process are hidden."""

    def __init__(self, folder: Path, step: int):
        self.writer = SummaryWriter(str(folder), purge_step=step + 1)
        self._is_closed = False
