"""How often intervals of a difference hold the truth: python benchmarks/coverage.py.

Eight encoders, each from its own data set, of one, two or four runs, are compared with a baseline
on the same seeds. An encoder adds what has an SD of a given size, what a seed draws is shared by
both sides, and each run adds its own; all together have an SD of 1 on either side. Units are what
jbrep tests with; the others are what could be done instead.
"""

import argparse
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.text import table

Array = NDArray[np.float64]
ENCODERS = 8
RESAMPLES = 400
TRUTHS = {  # shares of the variance: of encoders, of seeds, of runs; and the runs' shape
    "runs differ": (0.0, 0.0, "normal"),
    "seeds differ": (0.0, 0.6, "normal"),
    "encoders differ": (0.6, 0.0, "normal"),
    "both differ": (0.4, 0.4, "normal"),
    "both, skewed": (0.4, 0.4, "skewed"),
    "both, a tenth fails": (0.4, 0.4, "failing"),
}


def noise(random: np.random.Generator, shape: tuple[int, ...], how: str) -> Array:
    """Standardised: normal, or with most values near the top, or with a tenth far below."""
    if how == "skewed":
        return (2 - random.gamma(2, 1, shape)) / np.sqrt(2)
    if how == "failing":
        return np.where(random.random(shape) < 0.1, -3.0, 1 / 3) + random.normal(0, 0.1, shape)
    return random.standard_normal(shape)


def sides(random: np.random.Generator, studies: int, runs: int, truth: str) -> tuple[Array, Array]:
    """Returns of encoders and of a baseline, (studies, encoders, runs) each, of equal means."""
    of_encoders, of_seeds, how = TRUTHS[truth]
    shape = studies, ENCODERS, runs
    shared = np.sqrt(of_seeds) * random.standard_normal(shape)
    encoders = np.sqrt(of_encoders) * random.standard_normal((studies, ENCODERS, 1))
    own = np.sqrt(1 - of_encoders - of_seeds)
    x = encoders + shared + own * noise(random, shape, how)
    return x, shared + np.sqrt(1 - of_seeds) * noise(random, shape, how)


def units(x: Array, y: Array) -> tuple[Array, Array]:
    """Student's interval over differences of the encoders' means."""
    _, low, high = mean_within((x - y).mean(axis=-1), Bounds(), LEVEL)
    return low, high


def by_run(x: Array, y: Array) -> tuple[Array, Array]:
    """The same over differences of runs, whatever their encoder."""
    _, low, high = mean_within((x - y).reshape(len(x), -1), Bounds(), LEVEL)
    return low, high


def unpaired(x: Array, y: Array) -> tuple[Array, Array]:
    """Two samples of runs, as if they shared nothing."""
    of_x, of_y = (mean_within(each.reshape(len(each), -1), Bounds(), LEVEL) for each in (x, y))
    half = np.sqrt((of_x.value - of_x.low) ** 2 + (of_y.value - of_y.low) ** 2)
    return of_x.value - of_y.value - half, of_x.value - of_y.value + half


def nested_bootstrap(x: Array, y: Array) -> tuple[Array, Array]:
    """Percentiles over encoders drawn anew, then runs of each."""
    random, difference = np.random.default_rng(0), x - y
    studies, encoders, runs = difference.shape
    drawn = []
    for _ in range(RESAMPLES):
        which = random.integers(0, encoders, (studies, encoders, 1))
        of_each = random.integers(0, runs, (studies, encoders, runs))
        drawn.append(difference[np.arange(studies)[:, None, None], which, of_each].mean((1, 2)))
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return low, high


METHODS: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "units": units,
    "runs": by_run,
    "unpaired": unpaired,
    "nested bootstrap": nested_bootstrap,
}


def main(studies: int) -> None:
    rows = []
    for truth in TRUTHS:
        for runs in (1, 2, 4):
            x, y = sides(np.random.default_rng(0), studies, runs, truth)
            cells = []
            for method in METHODS.values():
                low, high = method(x, y)
                cover = 100 * np.mean((low < 0) & (high > 0))
                cells.append(f"{cover:.1f} ({np.mean(high - low):.2f})")
            rows.append((truth, str(runs), *cells))
    print(f"coverage [%] of 95 % intervals, with their mean width, of {studies} studies")
    print(table(("truth", "runs of each", *METHODS), rows))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=4000)
    main(parser.parse_args().studies)
