"""Runs of reinforcement learning: the unit of replication is the run, that is, the seed."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from jbrep.encoders.header import EncoderName
from jbrep.errors import InputError
from jbrep.stats.bootstrap import Array
from jbrep.stats.intervals import Bounds

LARGEST_RETURN = 1e15  # of either sign: beyond, a number has diverged
_ROUNDING = 1e-6  # of returns, relative to the largest
_OF_TABLES = 6e-4  # of returns from 1 on, which have three decimals there


@dataclass(frozen=True, eq=False)
class RunCurve:
    """The returns of a run's evaluations over training.

    A failed run counts as the worst from the step of failure on, so that failing can't count in
    favour of a representation.
    """

    task: str
    algorithm: str
    representation: str  # what the agent observed: the name of the baseline or of an encoder
    seed: int
    settings: str  # a hash of the settings, or any text; equal for all runs under one label
    steps: NDArray[np.int64]  # training steps of the evaluations, (k,), ascending
    returns: Array  # of each evaluation's episodes, (k, e)
    total_steps: int  # training steps that were requested
    failed_at: int | None = None  # training step at which the run failed; None if it didn't
    # the least possible return of an episode of the task; None if unknown
    return_floor: float | None = None
    return_ceiling: float | None = None  # the largest possible one; None if unknown
    # the return that gains are counted over, on the starts of evaluation: that of the best blind
    # baseline; None if unknown
    reference: float | None = None
    # the same on the starts of `returns`; None if that is `reference`
    reference_in_training: float | None = None
    # the return that scores 1, where `reference` scores 0: that of a policy that can do the task,
    # on the starts of evaluation; None if unknown
    top: float | None = None
    # the same on the starts of `returns`; None if that is `top`
    top_in_training: float | None = None
    # the return from which on the task counts as solved; None if unknown
    solved: float | None = None
    environment: str = ""  # what decides which returns there can be; equal for all compared runs
    learner: str = ""  # a hash of the algorithm's settings; likewise
    # the returns of the last evaluation, if it has more episodes than the others, (f,)
    final: Array | None = None
    encoder_seed: int | None = None  # of the encoder, if the representation has several
    # what the run counts as once it has failed; None for the floor. `with_failure_returns` sets it
    # for runs that are compared
    failure_return: float | None = None

    def __post_init__(self) -> None:
        if self.failed_at is None and len(self.steps) < 2:
            raise self._error(
                f"its number of evaluations is {len(self.steps)}",
                "a curve needs at least two; the episodes of one evaluation are not runs",
            )
        every, (low, high) = np.concatenate([*self.evaluations, []]), self.bounds
        largest = np.abs(every).max(initial=0)
        rounding = max(_OF_TABLES if largest >= 1 else _ROUNDING, _ROUNDING * largest)
        if (every < low - rounding).any() or (every > high + rounding).any():
            raise self._error(
                f"it returned {every.min():g} to {every.max():g}",
                f"its task says that returns are from {low:g} to {high:g}",
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
    episode in which a run of that task and algorithm was evaluated, whatever its representation, or
    the best blind baseline if that is less. Where none was evaluated, it stays as it was.
    """
    worst: dict[Key, float] = {}
    for run in runs:
        every = np.concatenate([*run.evaluations, [np.inf]])
        seen = run.return_floor
        if seen is None:
            blind = (run.reference, run.reference_in_training) if len(run.steps) else ()
            seen = min([every.min(), *(each for each in blind if each is not None)])
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
    _check_alike(list(chain.from_iterable(ordered.values())), "/".join(key))
    return ordered


def in_order(names: Iterable[str], baseline: str) -> list[str]:
    """Representations as tables and figures order them: the baseline first, dae-12 before dae-8."""

    def key(name: str) -> tuple[bool, tuple[str, int, int], str]:
        return name != baseline, EncoderName.parse(name).order, name

    return sorted(set(names), key=key)


def _check_alike(runs: list[RunCurve], name: str) -> None:
    if runs[0].failure_return is None:
        raise InputError(f"{name}: every run failed before its first evaluation: see why they did")
    for what in ("environment", "learner"):
        if len(several := sorted({getattr(run, what) for run in runs})) > 1:
            raise InputError(
                f"{name}: its runs are of different {what}s: {' and '.join(several)}; report those "
                "of one"
            )
    for what, counts in (
        ("evaluations", {run.returns.shape[1] for run in runs if len(run.steps)}),
        ("last evaluations", {len(run.final) for run in runs if run.final is not None}),
    ):
        if len(counts) > 1:
            numbers = " and ".join(map(str, sorted(counts)))
            raise InputError(
                f"{name}: the {what} of its runs have {numbers} episodes: report runs with equal "
                "numbers"
            )
    for label in dict.fromkeys(run.label for run in runs):
        settings = sorted({run.settings for run in runs if run.label == label})
        if len(settings) > 1:
            raise InputError(
                f"{label} mixes the settings {', '.join(settings)}: give runs with other settings "
                "another name"
            )
