"""Runs of reinforcement learning: the unit of replication is the run, that is, the seed."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError
from jbrep.stats.bootstrap import Array
from jbrep.stats.intervals import Bounds

LARGEST_RETURN = 1e15  # of either sign: beyond, a number has diverged
_ROUNDING = 1e-6  # of returns, relative to the largest
# alike for all runs of a task
_OF_TASK = ("return_floor", "return_ceiling", "reference", "top", "solved")


@dataclass(frozen=True, eq=False)
class RunCurve:
    """The returns of a run's evaluations over training.

    A failed run counts as the worst from the step of failure on, so that failing can't count in
    favour of a representation.

    Args:
        task: the task's name.
        algorithm: the algorithm's name.
        representation: what the agent observed: the name of the baseline or of an encoder.
        seed: of the run.
        settings: a hash of the settings, or any text; equal for all runs under one label.
        steps: training steps of the evaluations, (k,), ascending.
        returns: of each evaluation's episodes, (k, e).
        total_steps: training steps that were requested.
        failed_at: training step at which the run failed; None if it didn't.
        return_floor: the least possible return of an episode of the task; None if unknown.
        return_ceiling: the largest possible one; None if unknown.
        reference: the return that gains are counted over, on the starts of evaluation: that of the
            best policy that doesn't look; None if unknown.
        reference_in_training: the same on the starts of `returns`; None if that is `reference`.
        top: the return that scores 1, where `reference` scores 0: that of a policy that can do the
            task, on the starts of evaluation; None if unknown.
        top_in_training: the same on the starts of `returns`; None if that is `top`.
        solved: the return from which on the task counts as solved; None if unknown.
        environment: what decides which returns there can be; equal likewise.
        final: the returns of the last evaluation, if it has more episodes than the others, (f,).
        encoder_seed: of the encoder, if the representation has several.
        failure_return: what the run counts as once it has failed; None for the floor.
            `with_failure_returns` sets it for runs that are compared.
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
    return_floor: float | None = None
    return_ceiling: float | None = None
    reference: float | None = None
    reference_in_training: float | None = None
    top: float | None = None
    top_in_training: float | None = None
    solved: float | None = None
    environment: str = ""
    final: Array | None = None
    encoder_seed: int | None = None
    failure_return: float | None = None

    def __post_init__(self) -> None:
        if self.failed_at is None and len(self.steps) < 2:
            raise self._error(
                f"its number of evaluations is {len(self.steps)}",
                "a curve needs at least two; the episodes of one evaluation are not runs",
            )
        every = self.returns if self.final is None else np.append(self.returns, self.final)
        if every.size:
            self._check_bounds(float(every.min()), float(every.max()))

    def _check_bounds(self, least: float, largest: float) -> None:
        rounding = _ROUNDING * max(1, abs(least), abs(largest))
        if least < self.bounds.low - rounding:
            raise self._error(
                f"its least return is {least:g}", f"its task has none below {self.bounds.low:g}"
            )
        if largest > self.bounds.high + rounding:
            raise self._error(
                f"its largest return is {largest:g}",
                f"its task has none above {self.bounds.high:g}",
            )

    @property
    def bounds(self) -> Bounds:
        """Of the returns of the task."""
        return Bounds.of(self.return_floor, self.return_ceiling)

    @property
    def evaluations(self) -> list[Array]:
        """The returns of each evaluation, (e,), of the last one maybe more."""
        return [*self.returns] if self.final is None else [*self.returns[:-1], self.final]

    @property
    def label(self) -> str:
        """Task, algorithm and representation, which runs that differ only by seed share."""
        return f"{self.task}/{self.algorithm}/{self.representation}"

    def curve(self) -> tuple[NDArray[np.int64], Array]:
        """Training steps and mean returns over episodes, (k,) each.

        A failed run ends with its failure_return: NaN where neither that nor the floor is known.
        """
        steps, returns = self.steps, self.returns.mean(axis=1)
        if self.failed_at is None:
            return steps, returns
        before = steps < self.failed_at
        last = self.return_floor if self.failure_return is None else self.failure_return
        ends = np.nan if last is None else last
        return np.append(steps[before], self.failed_at), np.append(returns[before], ends)

    def _error(self, wrong: str, expected: str) -> InputError:
        return InputError(f"run {self.label}, seed {self.seed}: {wrong}; {expected}")


Group = dict[str, list[RunCurve]]  # runs by seed, under their representation
Key = tuple[str, str]  # task and algorithm


def with_failure_returns(runs: Sequence[RunCurve]) -> list[RunCurve]:
    """The same runs with what a failed one counts as: the worst of its task and algorithm.

    That is the least possible return of the task where it is known, else the worst return of any
    episode in which a run of that task and algorithm was evaluated, whatever its representation.
    Where none was evaluated, it stays as it was.
    """
    worst: dict[Key, float] = {}
    for run in runs:
        every = run.returns if run.final is None else np.append(run.returns, run.final)
        seen = every.min(initial=np.inf) if run.return_floor is None else run.return_floor
        key = run.task, run.algorithm
        worst[key] = min(worst.get(key, np.inf), float(seen))
    known = {key: value for key, value in worst.items() if np.isfinite(value)}
    return [
        replace(run, failure_return=known.get((run.task, run.algorithm), run.failure_return))
        for run in runs
    ]


def groups(runs: Sequence[RunCurve], baseline: str) -> dict[Key, Group]:
    """Runs by (task, algorithm), then by representation, the baseline first.

    The order doesn't depend on that of the runs given. Each run has its failure_return.
    """
    by_group: dict[Key, Group] = defaultdict(lambda: defaultdict(list))
    for run in with_failure_returns(runs):
        by_group[run.task, run.algorithm][run.representation].append(run)
    if not by_group:
        raise InputError("there are no runs: give at least two of the baseline")
    return {key: _ordered(by_group[key], key, baseline) for key in sorted(by_group)}


def evaluated_run(group: Mapping[str, Sequence[RunCurve]]) -> RunCurve:
    """A run of a group that was evaluated, if any was: only it says on how many starts."""
    return max(chain.from_iterable(group.values()), key=lambda run: len(run.steps) > 0)


def _ordered(group: Group, key: Key, baseline: str) -> Group:
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
    _check_task(list(chain.from_iterable(ordered.values())), "/".join(key))
    return ordered


def in_order(names: Iterable[str], baseline: str) -> list[str]:
    """Representations as tables and figures order them: the baseline first, dae-12 before dae-8."""

    def key(name: str) -> tuple[bool, tuple[str, int, int], str]:
        return name != baseline, EncoderName.parse(name).order, name

    return sorted(set(names), key=key)


def _check_task(runs: list[RunCurve], name: str) -> None:
    if runs[0].failure_return is None:
        raise InputError(f"{name}: every run failed before its first evaluation: see why they did")
    if len(environments := sorted({run.environment for run in runs})) > 1:
        raise InputError(
            f"{name}: its runs are of different environments: {' and '.join(environments)}; report "
            "those of one"
        )
    for what, counts in (
        ("evaluations", {run.returns.shape[1] for run in runs if len(run.steps)}),
        ("last evaluations", {len(run.final) for run in runs if run.final is not None}),
    ):
        if len(counts) > 1:
            told = " and ".join(map(str, sorted(counts)))
            raise InputError(
                f"{name}: the {what} of its runs have {told} episodes: report those of one number"
            )
    for what in _OF_TASK:
        values = sorted({str(getattr(run, what)) for run in runs})
        if len(values) > 1:
            raise InputError(
                f"{name}: its runs say different {what}: {', '.join(values)}; give one for a task"
            )


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
