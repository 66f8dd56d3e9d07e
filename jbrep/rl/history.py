"""What a run has recorded so far, and where it is shown: on a terminal, and in logs."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from statistics import fmean
from typing import Any

from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from jbrep.envs.recording import Outcome
from jbrep.progress import Progress
from jbrep.records import tables
from jbrep.rl.files import Episode, Evaluation, Info
from jbrep.rl.run_settings import RunSettings
from jbrep.text import rounded

_LINE = "{desc}: {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"  # on a terminal
_NAME = 16  # letters in it, at most


@dataclass
class History:
    """What a run has recorded so far, over all the processes that worked on it."""

    episodes: list[Episode] = field(default_factory=list)  # of training
    evaluations: list[Evaluation] = field(default_factory=list)  # of the deterministic policy
    # what the environment told at the ends of their episodes
    infos: list[Info] = field(default_factory=list)
    seconds_before: float = 0.0  # wall time of earlier processes [s]
    first_step: int = 0  # the training step from which this process continues
    _started: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """The wall time so far."""
        return round(self.seconds_before + time.monotonic() - self._started, 1)

    @property
    def last_mean(self) -> float | None:
        """The mean return of the last evaluation; None before the first."""
        last = self.evaluations[-1:]
        own = takewhile(lambda each: each.step == last[0].step, reversed(self.evaluations))
        return fmean(each.episode_return for each in own) if last else None

    def add(self, step: int, outcome: Outcome) -> None:
        """Record an evaluation after so many steps."""
        returns: Sequence[float] = [tables.as_in_tables(each) for each in outcome.returns]
        self.evaluations += [Evaluation(step, i, each) for i, each in enumerate(returns)]
        numbered = enumerate(outcome.numbers)
        self.infos += [Info(step, i, *each) for i, numbers in numbered for each in numbers.items()]

    def drop_from(self, step: int) -> None:
        """Drop the evaluations after so many steps, or more."""
        self.evaluations = [row for row in self.evaluations if row.step < step]
        self.infos = [row for row in self.infos if row.step < step]


class Bar:
    """A line of progress, from the step on at which the run starts or resumes."""

    def __init__(self, steps: int, name: str):
        self._steps = steps
        self._name = name if len(name) <= _NAME else f"{name[: _NAME - 3]}..."
        self._progress: Any = None

    def show(self, history: History, step: int) -> None:
        """Show the steps so far and the mean returns of the evaluations.

        The final evaluation can take minutes: all steps are told before it, and after it again.
        """
        if self._progress is None:
            self._progress = Progress(
                total=self._steps,
                initial=step,
                desc=self._name,
                unit="",
                unit_scale=True,
                delay=0.5,
                bar_format=_LINE,
            )
        is_final = self._progress.n < self._steps <= step
        self._progress.update(min(step, self._steps) - self._progress.n)
        last = "-" if history.last_mean is None else rounded(history.last_mean)[0]
        shown = "final ones under way" if is_final else last
        self._progress.set_postfix(returns=shown, refresh=is_final)

    def close(self) -> None:
        """End the line."""
        if self._progress is not None:
            self._progress.close()


class ControlStepsLogger(Logger):
    """stable-baselines3's logger, with control steps instead of its agent's, for TensorBoard."""

    def __init__(self, settings: RunSettings, scalars: KVWriter):
        super().__init__(None, [scalars])
        self._settings = settings

    def dump(self, step: int = 0) -> None:
        super().dump(self._settings.control_steps(step))


class Scalars(TensorBoardOutputFormat):
    """TensorBoard's file after a step; later ones of an earlier process are hidden."""

    def __init__(self, folder: Path, step: int):
        self.writer = SummaryWriter(str(folder), purge_step=step + 1)
        self._is_closed = False
