"""What the claims compare: the runs of each representation, measured on one scale."""

from collections.abc import Collection, Mapping
from itertools import chain
from typing import NamedTuple

import numpy as np

from jbrep.stats.bootstrap import Array
from jbrep.stats.curves import Compared, compared, final_return, steps_to
from jbrep.stats.intervals import Bounds, surely_above
from jbrep.stats.runs import Group, RunCurve, evaluated_run, with_failure_returns
from jbrep.stats.scale import references

FEWEST_UNITS = 8  # units on either side of a verdict
_HALF = 0.5  # of the baseline's gain: what a run that learns comes to
_RESOLUTION = 0.01  # of that gain, of differences between curves


class Frame(NamedTuple):
    """What the runs of a task and algorithm are held to."""

    reference: float  # the return that gains are counted over
    half: float  # the return half-way from there to the baseline's mean final return
    half_in_training: float  # the same on the starts of the evaluations during training
    bounds: Bounds  # of returns
    steps: float  # of training
    weights: Array  # of the evaluations in a mean over training, (g,), with a sum of 1
    resolution: float  # of differences between curves


class Arm(NamedTuple):
    """The runs of a representation.

    A unit is what is independent of the others: a run, or an encoder with its runs if each of many
    encoders has its own.
    """

    final: Array  # the mean final return of each unit, (u,)
    time: Array  # the mean of its runs' steps to half of the gain, at most all of training, (u,)
    curves: Array  # the first run of each unit over training, (u, g)
    runs: int  # how many there are
    learnt: int  # of how many units all runs end above the frame's half
    by_encoder: bool  # whether units are encoders

    @property
    def units(self) -> int:
        """How many there are."""
        return len(self.final)


class Sides(NamedTuple):
    """The arm of a representation, x, against that of the baseline, y, and what holds for both."""

    x: Arm
    y: Arm
    frame: Frame


def measure(group: Group, seeds: Collection[int]) -> tuple[Frame, dict[str, Arm]]:
    """The frame of a group and the arms of its representations, the baseline first.

    Args:
        group: runs by representation.
        seeds: that count; others are left out, but for what units are. What a failed run counts as
            is known from these alone, too.

    Raises:
        InputError: the runs have no range of steps in common.
    """
    counted = with_failure_returns([r for r in chain(*group.values()) if r.seed in seeds])
    of_each = {name: [r for r in counted if r.representation == name] for name in group}
    there = {name: runs for name, runs in of_each.items() if runs}
    known = compared(there)
    frame = _frame(there, known)
    return frame, {
        name: _arm(runs, _own_encoders(group[name]), name, known, frame)
        for name, runs in there.items()
    }


def learns(arm: Arm, frame: Frame) -> bool:
    """Whether runs end above what gains are counted over, beyond chance."""
    return surely_above(arm.final, frame.reference, frame.bounds)


def _frame(group: Mapping[str, list[RunCurve]], known: Compared) -> Frame:
    first = evaluated_run(group)
    grid, curves, finals = known.grid, known.of_baseline, known.finals
    of_baseline = next(iter(finals.values()))
    reference, over = references(known, first)
    gain = max(float(of_baseline.mean()) - reference, 0.0)
    gain_in_training = max(float(final_return(curves, grid).mean()) - over, 0.0)
    widths = np.diff(grid)
    weights = (np.append(widths, 0) + np.append(0, widths)) / 2
    largest = max(float(np.abs(each).max()) for each in finals.values())
    return Frame(
        reference=reference,
        half=reference + _HALF * gain,
        half_in_training=over + _HALF * gain_in_training,
        bounds=first.bounds,
        steps=float(grid[-1] - grid[0]),
        weights=weights / weights.sum(),
        resolution=_RESOLUTION * gain or _RESOLUTION * largest or 1.0,
    )


def _arm(runs: list[RunCurve], by_encoder: bool, name: str, known: Compared, frame: Frame) -> Arm:
    grid, curves, final = known.grid, known.curves[name], known.finals[name]
    units = of_encoders(runs) if by_encoder else [[number] for number in range(len(runs))]
    time = np.minimum(steps_to(curves, grid, frame.half_in_training) - grid[0], frame.steps)
    return Arm(
        final=np.array([final[unit].mean() for unit in units]),
        time=np.array([time[unit].mean() for unit in units]),
        curves=np.stack([curves[unit[0]] for unit in units]),
        runs=len(final),
        learnt=sum(bool((final[unit] >= frame.half).all()) for unit in units),
        by_encoder=by_encoder,
    )


def _own_encoders(runs: list[RunCurve]) -> bool:
    """Whether there are enough encoders to speak of others made like them."""
    return len({run.encoder_seed for run in runs} - {None}) >= FEWEST_UNITS


def of_encoders(runs: list[RunCurve]) -> list[list[int]]:
    """The numbers of the runs of each encoder."""
    by_encoder: dict[int | None, list[int]] = {}
    for number, run in enumerate(runs):
        by_encoder.setdefault(run.encoder_seed, []).append(number)
    return list(by_encoder.values())
