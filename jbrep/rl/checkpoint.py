"""What a run has recorded so far, and its checkpoint, which runs no code when it is read."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from stable_baselines3.common.base_class import BaseAlgorithm

from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.envs.recording import Outcome
from jbrep.errors import DamageError, InputError, differences
from jbrep.records import container
from jbrep.records.container import Tensors
from jbrep.records.document import Document, document_from
from jbrep.records.record import Version, shown
from jbrep.records.storage import exists
from jbrep.records.tables import rounded
from jbrep.rl.agent import parameters, restore_statistics, statistics_of
from jbrep.rl.files import CHECKPOINT, RUN, Episode, Evaluation, Info, read_run
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_STEPS

PARAMETERS = "parameters."  # begins the names of what gradient steps change
LANES = "lanes."  # likewise, of what decides how the lanes continue
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")  # of an agent
_QUICK = 2.0  # seconds of writing that don't matter
_MALFORMED = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
WEIGHTS_NOT_FINITE = "the policy's weights are not finite"  # reasons for a run to fail
ACTIONS_NOT_FINITE = "the policy's actions are not finite"


class DivergedError(ArithmeticError):
    """A loss or a weight of the policy is NaN or infinite: training can't continue."""


@dataclass
class History:
    """What a run has recorded so far, over all the processes that worked on it.

    Attributes:
        episodes: of training.
        evaluations: of the deterministic policy.
        infos: what the environment told at the ends of their episodes.
        first_step: the training step from which this process continues.
        earlier_seconds: the wall time that earlier processes took.
        means: returns of the evaluations.
    """

    episodes: list[Episode] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    infos: list[Info] = field(default_factory=list)
    first_step: int = 0
    earlier_seconds: float = 0.0
    means: list[float] = field(default_factory=list)
    _started: float = field(default_factory=time.monotonic)

    def start(self) -> None:
        """Count the time from now on: others may have been trained since this was made."""
        self._started = time.monotonic()

    @property
    def seconds(self) -> float:
        """The wall time so far."""
        return round(self.earlier_seconds + time.monotonic() - self._started, 1)

    @property
    def mean(self) -> float | None:
        """The mean return of the last evaluation, once there was one."""
        return self.means[-1] if self.means else None

    def evaluated(self, step: int, outcome: Outcome) -> None:
        """Record an evaluation after so many steps."""
        returns = [rounded(each) for each in outcome.returns]
        self.evaluations += [Evaluation(step, i, each) for i, each in enumerate(returns)]
        told = enumerate(outcome.numbers)
        self.infos += [Info(step, i, *each) for i, numbers in told for each in numbers.items()]
        self.means.append(float(np.mean(returns)))

    def forget_from(self, step: int) -> None:
        """Forget the evaluations after so many steps, or more."""
        self.evaluations = [row for row in self.evaluations if row.step < step]
        self.infos = [row for row in self.infos if row.step < step]
        self.means = self._means()

    def resume(self, header: "CheckpointHeader") -> None:
        """Continue from an earlier process's record."""
        self.episodes, self.evaluations = header.episodes, header.evaluations
        self.infos = header.infos
        self.earlier_seconds, self.first_step = header.seconds, header.step
        self.means = self._means()

    def _means(self) -> list[float]:
        by_step = groupby(self.evaluations, lambda each: each.step)
        return [float(np.mean([each.episode_return for each in own])) for _, own in by_step]


class StoppedError(Exception):
    """A run stopped on request after so many steps, its checkpoint written; `train` resumes it."""

    def __init__(self, step: int):
        super().__init__(f"stopped after {step:,} steps")
        self.step = step


class Snapshot(NamedTuple):
    """Everything that decides how an agent's training continues."""

    tensors: Tensors
    counters: dict[str, Any]  # plain JSON


def take(agent: BaseAlgorithm) -> Snapshot:
    """What an agent itself continues from, whatever trains it; tensors share its memory."""
    tensors = {f"{PARAMETERS}{name}": tensor.numpy() for name, tensor in parameters(agent)}
    if statistics := statistics_of(agent):
        tensors |= statistics.tensors
    counters = {name: getattr(agent, name) for name in _COUNTERS}
    episodes = [{k: float(v) for k, v in e.items()} for e in agent.ep_info_buffer or ()]
    return Snapshot(tensors, {**counters, "episodes": episodes})


def restore(agent: BaseAlgorithm, snapshot: Snapshot) -> None:
    """Bring an agent that is set up to learn to where `take` was."""
    tensors, counters = snapshot
    with torch.no_grad():
        for name, tensor in parameters(agent):
            tensor.copy_(torch.from_numpy(tensors[f"{PARAMETERS}{name}"]))
    restore_statistics(agent, tensors, "the checkpoint")
    for name in _COUNTERS:
        setattr(agent, name, counters[name])
    agent._num_timesteps_at_start = agent.num_timesteps  # of the rate that TensorBoard shows
    agent.start_time = time.time_ns()
    assert agent.ep_info_buffer is not None
    agent.ep_info_buffer.clear()  # it may go on from a checkpoint of its own
    agent.ep_info_buffer.extend(counters["episodes"])


class CheckpointHeader(Document, frozen=True, kw_only=True):
    """The header of a checkpoint.

    Attributes:
        settings: of the run.
        versions: by package; these and the settings must be equal for the run to resume.
        step: of training.
        episodes, evaluations, infos, seconds: of the history so far.
        counters: of the snapshot.
    """

    format = "jbrep checkpoint"
    format_version = 4

    settings: RunSettings
    versions: Mapping[Version, Version]
    step: Annotated[int, Meta(ge=0, le=MAX_STEPS)]
    episodes: list[Episode]
    evaluations: list[Evaluation]
    infos: list[Info]
    seconds: float
    counters: Mapping[str, Any]

    def check(self) -> None:
        super().check()
        for name in _COUNTERS:
            count = self.counters.get(name, 0)
            if type(count) is not int or count < 0:
                raise InputError(f"{name} is {shown(count)}: it must be a whole number from 0")


def read_checkpoint(path: Path) -> tuple[Tensors, CheckpointHeader]:
    """A run's checkpoint.

    Raises:
        DamageError: it isn't what was written.
    """
    tensors, header = container.read(path, "checkpoint")
    return tensors, document_from(header, path, CheckpointHeader)


def run_settings(folder: Path) -> RunSettings:
    """The settings of a run that has ended or is under way.

    Of a checkpoint the header alone is read, as the file can be large.

    Raises:
        DamageError: a file isn't what was written.
    """
    if exists(folder / RUN):
        return read_run(folder).settings
    path = folder / CHECKPOINT
    return document_from(container.peek(path), path, CheckpointHeader).settings


class CheckpointFile:
    """Where a run's snapshots are kept, the last one alone, each with the history of then."""

    def __init__(
        self, path: Path, settings: RunSettings, versions: Mapping[str, str], history: History
    ):
        self.path, self._history = path, history
        self._settings, self._versions = settings, versions
        self._saved, self._took = time.monotonic(), 0.0

    def is_due(self, every: float, together: int = 1) -> bool:
        """Whether to write the next one.

        Args:
            every: seconds between them; where writing takes more than two seconds, in proportion
                more.
            together: files as large as this that are written one after the other.
        """
        age = time.monotonic() - self._saved
        return age >= every * max(1.0, self._took * together / _QUICK)

    def read(self) -> Snapshot | None:
        """The snapshot, the history brought to where it was; None if there is none."""
        if not exists(self.path):
            return None
        tensors, header = read_checkpoint(self.path)
        versions, settings = differences(header.versions, self._versions), header.settings
        if settings.is_extended_by(self._settings) and not settings.schedules:
            settings = self._settings
        if others := settings.differing(self._settings) or versions:
            told = f"{self.path} belongs to another configuration: {others}; choose another folder"
            has_ended = exists(self.path.with_name(RUN))  # with fewer steps, which need the file
            raise InputError(told if has_ended else f"{told}, or delete the file to start over")
        self._history.resume(header)
        return Snapshot(tensors, dict(header.counters))

    def write(self, snapshot: Snapshot) -> None:
        """Replace the last one."""
        header = CheckpointHeader(
            settings=self._settings,
            versions=self._versions,
            step=self._settings.control_steps(snapshot.counters["num_timesteps"]),
            episodes=self._history.episodes,
            evaluations=self._history.evaluations,
            infos=self._history.infos,
            seconds=self._history.seconds,
            counters=snapshot.counters,
        )
        begun = time.monotonic()
        container.write(self.path, snapshot.tensors, header.as_json())
        self._saved = time.monotonic()
        self._took = self._saved - begun

    @contextmanager
    def resuming(self) -> Iterator[None]:
        """Name the file where training can't continue from its snapshot."""
        try:
            yield
        except EnvironmentFailedError as error:
            raise InputError(f"{self.path} can't be resumed: {error}") from None
        except InputError:
            raise
        except _MALFORMED:
            raise DamageError(f"{self.path} is damaged: delete it to start over") from None
