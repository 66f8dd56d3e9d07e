"""What all representations of a task and algorithm are measured by."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.curves import Compared, final_return
from jbrep.stats.intervals import UNDEFINED, surely_above
from jbrep.stats.runs import RunCurve, evaluated_run

SHARES = {"50_percent": 0.5, "90_percent": 0.9}  # of the gain of the baseline's median run
SOLVED = "steps_to_solved"
STILL, CONSTANT, RANDOM = "standing still", "constant action", "random"  # blind baselines
BLIND = (STILL, CONSTANT, RANDOM)
LOOKING = "scripted"  # what tables call the scripted policy
STEPS_TO = (*(f"steps_to_{name}" for name in SHARES), SOLVED)
_POINTS = 50  # of a performance profile, about, or half as many: round numbers
_FAR = 1_000  # times the range of returns, beyond which a floor is no place to begin


class Ends(NamedTuple):
    """The returns that score 0 and 1."""

    blind: float  # of the best blind baseline, over which gains are counted
    blind_in_training: float  # the same on the starts of the evaluations during training
    top: float  # of a policy that can do the task; NaN if none is known, or above blind

    def score(self, returns: Array) -> Array:
        """Returns, or NaN where they have no score."""
        return (returns - self.blind) / (self.top - self.blind)


class Scale(NamedTuple):
    """What all representations of a task and algorithm are measured by."""

    grid: Array  # training steps at which runs are compared, (g,)
    ends: Ends  # the returns that score 0 and 1
    blind: Interval  # the mean return of the best blind baseline, by `_blind`
    # the return to reach for each of STEPS_TO, NaN where there is none
    thresholds: Mapping[str, float]
    # at which performance profiles are evaluated, (k,): round numbers that enclose all final
    # returns
    profile_returns: Array


def best_blind(returns: Mapping[str, float]) -> str | None:
    """The best blind baseline, by mean return; None if there is none."""
    blind = [policy for policy in BLIND if policy in returns]
    return max(blind, key=returns.__getitem__) if blind else None


def ends_of(compared: Compared) -> Ends:
    """The ends of the scale of a group, each from the same starts as what is held against it.

    The starts of the evaluations during training may be fewer than those of the last. Gains are
    over the run's own reference where it is known, else over the least possible return of the task.
    Where neither is known, it is that of untrained policies: the mean of the baseline's curves at
    their first step.
    """
    run = evaluated_run(compared.runs)
    known = (each for each in (run.reference, run.return_floor) if each is not None)
    last = float(next(known, compared.of_baseline[:, 0].mean()))
    training = last if run.reference_in_training is None else run.reference_in_training
    top = run.top
    if not compared.on_all_starts and run.top_in_training is not None:
        top = run.top_in_training
    blind = last if compared.on_all_starts else training
    return Ends(
        blind=blind, blind_in_training=training, top=np.nan if top is None or top <= blind else top
    )


def scale_of(compared: Compared, policies: Mapping[str, Interval]) -> Scale:
    """The scale of a group of runs.

    `policies` are mean returns of policies that don't learn, on the starts of the final returns.
    """
    grid, curves, finals = compared.grid, compared.of_baseline, [*compared.finals.values()]
    run, ends = evaluated_run(compared.runs), ends_of(compared)
    gained = surely_above(finals[0], ends.blind, run.bounds)
    gain = float(np.median(final_return(curves, grid))) - ends.blind_in_training
    over = ends.blind_in_training
    shares = [over + share * gain if gained and gain > 0 else np.nan for share in SHARES.values()]
    thresholds = (*shares, np.nan if run.solved is None else float(run.solved))
    return Scale(
        grid=grid,
        ends=ends,
        blind=_blind(compared, run, policies),
        thresholds=dict(zip(STEPS_TO, thresholds, strict=True)),
        profile_returns=_round_numbers(np.concatenate(finals), run.return_floor),
    )


def _blind(compared: Compared, run: RunCurve, policies: Mapping[str, Interval]) -> Interval:
    """The mean return of the best blind baseline, with its interval.

    Where none is known it may be anything from the least possible return, or that of untrained
    policies, upwards.
    """
    if best := best_blind({name: float(each.value) for name, each in policies.items()}):
        return policies[best]
    if run.reference is not None:
        return UNDEFINED._replace(value=run.reference)
    untrained = float(compared.of_baseline[:, 0].mean())
    return Interval(max(untrained, run.bounds.low), np.nan, np.inf)


def _round_numbers(returns: Array, floor: float | None) -> Array:
    """Round numbers, evenly spaced, to the largest return: from the floor, or from below them all.

    The latter where no floor is known, or it is far below them.
    """
    low, high = float(returns.min()), float(returns.max())
    if floor is not None and low - floor > _FAR * (high - low) > 0:
        floor = None
    low = low if floor is None else floor
    width = high - low
    if width <= 1e-6 * abs(high):  # all runs return the same
        width = abs(high) or 1.0
    exponent = math.floor(math.log10(width / _POINTS))
    unit = 10.0**exponent
    step = unit * next((s for s in (1, 2, 5) if s * unit >= width / _POINTS), 10)
    first = math.ceil(low / step) - 1 if floor is None else math.floor(low / step)
    last = max(math.ceil(high / step), first + 1)
    return np.round(step * np.arange(first, last + 1), max(0, -exponent))
