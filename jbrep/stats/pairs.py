"""Two representations of a task and algorithm, compared unit by unit.

Runs of one seed share what the seed draws: settings, the first weights, the starts. Runs of one
encoder share that, and the data that it was made from. So differences are taken within a unit: a
seed, or, where there are enough encoders, the seeds of an encoder and of those that are linked to
it. With a data set for each encoder, claims hold for encoders and data that are made like these.

Where each encoder has as many runs, the t-test of the units' means is the test of a linear mixed
model with random encoders (Searle, Casella and McCulloch 1992, "Variance Components"), exact for
normal returns, and without a fit that may fail. Coverage is tabulated in `jbrep.stats.intervals`.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from jbrep.stats.bootstrap import Array
from jbrep.stats.curves import Compared, compared, final_return, mean_return, rise, rises, steps_to
from jbrep.stats.intervals import LEVEL, Bounds, mean_within, surely_above
from jbrep.stats.runs import Group, evaluated_run, with_failure_returns
from jbrep.stats.scale import Ends, ends_of

FEWEST_UNITS = 8  # for a verdict; as many encoders are units
_HALF = 0.5  # of a gain: what a run that learns comes to
_RESOLUTION = 0.01  # of a gain, of differences between curves

Units = Sequence[Sequence[int]]  # the numbers of the runs of each


class Side(NamedTuple):
    """The runs of one representation, by unit."""

    final: Array  # mean final returns, (u,)
    mean: Array  # mean returns over training, (u,)
    steps: Array  # mean steps to half of y's gain, at most all of training, (u,)
    curves: Array  # of the first run of each unit over training, (u, g)
    rise: Array  # by `jbrep.stats.curves.rise`, (u,)
    failing: int  # units with a run that ends below half of what the median run gains


class Pair(NamedTuple):
    """A representation, x, and the one that it is compared with, y."""

    x: Side
    y: Side
    ends: Ends  # of the scale of returns
    bounds: Bounds  # of returns
    steps: float  # of training, at its end
    weights: Array  # of the evaluations in a mean over training, (g,), with a sum of 1
    resolution: float  # of differences between curves
    rising: bool  # whether a curve of either side surely still rises at the end of training
    runs: int  # on each side
    by_encoder: bool  # whether units are encoders

    @property
    def units(self) -> int:
        """How many there are."""
        return len(self.x.final)

    @property
    def y_learns(self) -> bool:
        """Whether y ends above the best blind baseline, beyond chance."""
        return surely_above(self.y.final, self.ends.blind, self.bounds)


def pair_of(group: Group, x: str, y: str, seeds: Collection[int]) -> Pair | None:
    """Representations x and y of a group; None where they share fewer than two of the seeds.

    Runs on others than these and the baseline, or with other seeds, have no effect.
    """
    names = dict.fromkeys([*[*group][:1], *(name for name in group if name in (x, y))])
    counted = with_failure_returns([r for n in names for r in group[n] if r.seed in seeds])
    there = {name: [r for r in counted if r.representation == name] for name in names}
    if not (there[x] and there[y]):
        return None
    return paired(compared({name: runs for name, runs in there.items() if runs}), x, y)


def paired(known: Compared, x: str, y: str) -> Pair | None:
    """As `pair_of`, of runs that are compared already."""
    rows = [{run.seed: row for row, run in enumerate(known.runs[name])} for name in (x, y)]
    shared = sorted(rows[0].keys() & rows[1].keys())
    if len(shared) < 2:
        return None
    of_x, of_y = ([each[seed] for seed in shared] for each in rows)
    encoders = [[known.runs[n][i].encoder_seed for i in at] for n, at in ((x, of_x), (y, of_y))]
    linked = linked_units(encoders)
    by_encoder = len(linked) >= FEWEST_UNITS and any(each[0] is not None for each in encoders)
    units = linked if by_encoder else [[i] for i in range(len(shared))]
    grid, first, ends = known.grid, evaluated_run(known.runs), ends_of(known)
    in_training = float(final_return(known.curves[y][of_y], grid).mean()) - ends.blind_in_training
    half = ends.blind_in_training + _HALF * max(in_training, 0.0)

    def side(name: str, at: list[int]) -> Side:
        final, curves = known.finals[name][at], known.curves[name][at]
        steps = np.minimum(steps_to(curves, grid, half) - grid[0], grid[-1] - grid[0])
        least = ends.blind + _HALF * max(float(np.median(final)) - ends.blind, 0.0)
        return Side(
            final=np.array([final[unit].mean() for unit in units]),
            mean=np.array([mean_return(curves[unit], grid).mean() for unit in units]),
            steps=np.array([steps[unit].mean() for unit in units]),
            curves=np.stack([curves[unit[0]] for unit in units]),
            rise=np.array([rise(curves[unit], grid).mean() for unit in units]),
            failing=sum(bool((final[unit] < least).any()) for unit in units),
        )

    sides, widths = (side(x, of_x), side(y, of_y)), np.diff(grid)
    weights = (np.append(widths, 0) + np.append(0, widths)) / 2
    gain = float(sides[1].final.mean()) - ends.blind
    largest = max(float(np.abs(each.final).max()) for each in sides)
    return Pair(
        *sides,
        ends=ends,
        bounds=first.bounds,
        steps=float(grid[-1]),
        weights=weights / weights.sum(),
        resolution=_RESOLUTION * max(gain, 0.0) or _RESOLUTION * largest or 1.0,
        rising=any(
            rises(mean_within(side.rise, Bounds(), LEVEL), float(side.final.mean()))
            for side in sides
        ),
        runs=len(shared),
        by_encoder=by_encoder,
    )


def linked_units(sides: Sequence[Sequence[int | None]]) -> Units:
    """Runs in sets that share no encoder, from the number of each run's encoder on either side.

    A side has None where all of its runs have one encoder: claims then hold for that one.
    """
    unit = np.arange(len(sides[0]))
    for encoders in map(np.array, sides):
        for encoder in set(encoders.tolist()) - {None}:
            linked = unit[encoders == encoder]
            unit[np.isin(unit, linked)] = linked.min()
    return [np.flatnonzero(unit == each).tolist() for each in np.unique(unit)]
