"""Runs of reinforcement learning: the unit of replication is the run, that is, the seed."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError
from jbrep.stats.bootstrap import Array

MAX_RETURN = 1000.0  # an episode's 1,000 steps, each with a reward in [0, 1]
_ROUNDING = 1e-6 * MAX_RETURN


@dataclass(frozen=True, eq=False)
class RunCurve:
    """The returns of a run's evaluations over training.

    A failed run counts as return 0 from the step of failure on: rewards are never negative, so
    failing can't count in favour of a representation.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        representation: what the agent observed: the name of the baseline or of an encoder.
        seed: of the run.
        settings: a hash of the settings, or any text; equal for all runs under one label.
        steps: training steps of the evaluations, (k,), ascending.
        returns: of each evaluation's episodes, (k, e), in [0, 1000].
        total_steps: training steps that were requested.
        failed_at: training step at which the run failed; None if it didn't.

    Raises:
        InputError: a field that doesn't fit this description.
    """

    task: str
    algorithm: str
    representation: str
    seed: int
    settings: str
    steps: NDArray[np.int64]
    returns: Array
    total_steps: int
    failed_at: int | None = None

    def __post_init__(self) -> None:
        if not _is_whole(self.seed):
            raise self._error(f"its seed is {self.seed!r}", "it must be a whole number")
        given, returns = np.asarray(self.steps), np.asarray(self.returns, float)
        if given.size and not np.issubdtype(given.dtype, np.integer):
            raise self._error(f"its steps are {given.dtype}", "they must be whole numbers")
        steps = given.astype(np.int64)
        if not steps.size and not returns.size:
            returns = returns.reshape(0, 1)  # failed before the first evaluation
        if given.ndim != 1 or np.any(np.diff(steps) <= 0):
            raise self._error("its steps don't ascend", "they must be ascending, (evaluations,)")
        if returns.ndim != 2 or len(returns) != len(steps) or not returns.shape[1]:
            raise self._error(
                f"its returns have the shape {returns.shape}",
                f"expected (evaluations, episodes), with {len(steps)} evaluations as in its steps",
            )
        if not np.isfinite(returns).all():
            raise self._error("its returns aren't finite", "set failed_at for a run that diverged")
        if (
            returns.size
            and not -_ROUNDING <= returns.min() <= returns.max() <= MAX_RETURN + _ROUNDING
        ):
            raise self._error(
                f"its returns are in [{returns.min():g}, {returns.max():g}]",
                f"they must be in [0, {MAX_RETURN:g}]",
            )
        self._check_length(steps)
        for name, value in (("steps", steps), ("returns", returns.copy())):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def _check_length(self, steps: NDArray[np.int64]) -> None:
        if self.failed_at is None and len(steps) < 2:
            raise self._error(
                f"its number of evaluations is {len(steps)}",
                "a curve needs at least two; the episodes of one evaluation are not runs",
            )
        if self.failed_at is not None and not 0 <= self.failed_at <= self.total_steps:
            raise self._error(
                f"it failed at step {self.failed_at}",
                f"that must be within 0 to {self.total_steps}",
            )
        if len(steps) and not 0 <= steps[0] <= steps[-1] <= self.total_steps:
            raise self._error(
                f"it was evaluated at steps {steps[0]} to {steps[-1]}",
                f"they must be within its total_steps, {self.total_steps}",
            )

    @property
    def label(self) -> str:
        """Task, algorithm and representation, which runs that differ only by seed share."""
        return f"{self.task}/{self.algorithm}/{self.representation}"

    def curve(self) -> tuple[NDArray[np.int64], Array]:
        """Training steps and mean returns over episodes, (k,) each; a failed run ends with 0."""
        steps, returns = self.steps, self.returns.mean(axis=1)
        if self.failed_at is None:
            return steps, returns
        before = steps < self.failed_at
        return np.append(steps[before], self.failed_at), np.append(returns[before], 0.0)

    def _error(self, wrong: str, expected: str) -> InputError:
        return InputError(f"run {self.label}, seed {self.seed}: {wrong}; {expected}")


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


Group = dict[str, list[RunCurve]]  # runs by seed, under their representation


def groups(runs: Sequence[RunCurve], baseline: str) -> dict[tuple[str, str], Group]:
    """Runs by (task, algorithm), then by representation, the baseline first.

    The order doesn't depend on that of the runs given.

    Raises:
        InputError: there is no run, something else than a run, a group without its baseline, or a
            label with one run, with a seed twice, or with different settings.
    """
    by_group: dict[tuple[str, str], Group] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        if not isinstance(run, RunCurve):
            raise InputError(
                f"runs contain a {type(run).__name__}: give one RunCurve for each run; episodes "
                "don't replace runs"
            )
        by_group[run.task, run.algorithm][run.representation].append(run)
    if not by_group:
        raise InputError("there are no runs: give at least two of the baseline")
    return {key: _ordered(by_group[key], key, baseline) for key in sorted(by_group)}


def _ordered(group: Group, key: tuple[str, str], baseline: str) -> Group:
    if baseline not in group:
        raise InputError(
            f"{'/'.join(key)} has no runs of the baseline {baseline!r}: train some, or choose "
            f"another baseline: {', '.join(sorted(group))}"
        )
    ordered = {
        name: sorted(group[name], key=lambda run: run.seed) for name in in_order(group, baseline)
    }
    for of_label in ordered.values():
        _check_label(of_label)
    return ordered


def in_order(names: Iterable[str], baseline: str) -> list[str]:
    """Representations as tables and figures order them: the baseline first, dae-12 before dae-8."""

    def key(name: str) -> tuple[bool, tuple[str, str, int], str]:
        return name != baseline, EncoderName.parse(name).order, name

    return sorted(set(names), key=key)


def _check_label(runs: list[RunCurve]) -> None:
    label, seeds = runs[0].label, [run.seed for run in runs]
    if len(runs) < 2:
        raise InputError(f"{label} has one seed: train at least two, preferably ten")
    if len(set(seeds)) < len(seeds):
        twice = next(seed for seed in seeds if seeds.count(seed) > 1)
        raise InputError(f"{label} has seed {twice} twice: give each run once")
    settings = sorted({run.settings for run in runs})
    if len(settings) > 1:
        raise InputError(
            f"{label} mixes the settings {', '.join(settings)}: give runs with other settings "
            "another name"
        )
