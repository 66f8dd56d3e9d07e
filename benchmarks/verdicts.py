"""How often verdicts are wrong, where the truth is known: python benchmarks/verdicts.py.

Studies of one primary cell are made up and judged at their default looks. Returns of runs are
normally distributed, skewed, or of runs of which some learn and others don't. A verdict is wrong
if it supports what isn't so, or contradicts what is; on the boundary of a claim any verdict is.
With the usual limit on the share of runs that may fail, a fifth, fewer than fourteen runs never
support anything; --failing 0.34 is a limit at which eight can.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.progress import Progress
from jbrep.stats import claims, spread
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import CLAIMS, CONTRADICTED, SUPPORTED
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import RunCurve
from jbrep.text import table

# verdicts come from p-values and the side of the boundary; intervals would take most of the time
_claims: Any = claims
_claims.ratio_of_spreads = lambda curves, *how: Interval(
    np.exp(spread._excess(curves, 0.0)), np.nan, np.nan
)

Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]
RUNS = (8, 10, 16, 20)
STEPS = np.arange(0, 100_001, 5_000)
STILL, MOST = 250.0, 1000.0
BOTH = (SUPPORTED, CONTRADICTED)
TASK, ALGORITHM, OTHER = "task", "algorithm", "other"


class Truth(NamedTuple):
    """How runs end on the full state and on less, and which verdicts on each claim are wrong."""

    full: Draw
    other: Draw
    wrong: tuple[tuple[str, ...], ...]  # by claim, in their order


def normal(mean: float, sd: float = 40) -> Draw:
    return lambda random, runs: random.normal(mean, sd, runs)


def skewed(mean: float, scale: float = 40) -> Draw:
    """Most near the top, some far below."""
    return lambda random, runs: mean + 2 * scale - random.gamma(2, scale, runs)


def failing(share: float) -> Draw:
    """Runs that learn, and runs that stand still."""

    def draw(random: np.random.Generator, runs: int) -> NDArray[np.float64]:
        learnt = random.normal(880, 30, runs)
        return np.where(random.random(runs) < share, random.normal(STILL, 15, runs), learnt)

    return draw


ON_MARGIN = STILL + 0.9 * (880 - STILL)
EQUAL = ((CONTRADICTED,), BOTH, BOTH, (CONTRADICTED,))
LESS = (BOTH, BOTH, BOTH, (SUPPORTED,))
WORSE = ((SUPPORTED,), BOTH, BOTH, (SUPPORTED,))
TRUTHS = {
    "normal, equal": Truth(normal(880), normal(880), EQUAL),
    "normal, a tenth of the gain less": Truth(normal(880), normal(ON_MARGIN), LESS),
    "skewed, equal": Truth(skewed(880), skewed(880), EQUAL),
    "skewed, a tenth of the gain less": Truth(skewed(880), skewed(ON_MARGIN), LESS),
    "a fifth fails on both": Truth(failing(0.2), failing(0.2), EQUAL),
    "a fifth fails on less state": Truth(normal(880), failing(0.2), WORSE),
    "a ninth fails on less state": Truth(normal(880), failing(0.11), WORSE),
    "all fail on less state": Truth(normal(880), failing(1), WORSE),
    "all fail on both": Truth(failing(1), failing(1), (BOTH,) * 4),
}


def study(truth: Truth, runs: int, seed: int) -> dict[str, list[RunCurve]]:
    """Made-up runs that rise around the middle of training."""
    random = np.random.default_rng(seed)

    def curve(name: str, number: int, end: float) -> RunCurve:
        middle = random.normal(50_000, 8_000)
        rise = 1 / (1 + np.exp(-(STEPS - middle) / 5_000))
        returns = STILL + (end - STILL) * rise + random.normal(0, 15, STEPS.shape)
        return RunCurve(
            *(TASK, ALGORITHM, name, number, "", STEPS),
            returns.clip(0, MOST)[:, None],
            total_steps=int(STEPS[-1]),
            return_floor=0,
            return_ceiling=MOST,
            reference=STILL,
        )

    arms = (("full", truth.full), (OTHER, truth.other))
    return {
        name: [curve(name, i, end) for i, end in enumerate(draw(random, runs).clip(0, MOST))]
        for name, draw in arms
    }


def judged(name: str, runs: int, failing: float, seed: int) -> tuple[str, ...]:
    """The verdicts on a made-up study."""
    rules = Rules(primary=(f"{TASK}/{ALGORITHM}/{OTHER}",), failing=failing)
    groups = {(TASK, ALGORITHM): study(TRUTHS[name], runs, seed)}
    found = Planned(rules, tuple(range(runs)))(groups, seed)
    return tuple(verdict.verdict for verdict in found[TASK, ALGORITHM][OTHER])


def main(studies: int, failing: float, sizes: Sequence[int]) -> None:
    rows = []
    with ProcessPoolExecutor() as pool:
        for name, runs in Progress([(name, n) for name in TRUTHS for n in sizes], unit="case"):
            found = [*pool.map(partial(judged, name, runs, failing), range(studies), chunksize=8)]
            cells = []
            for each, wrong in zip(zip(*found, strict=True), TRUTHS[name].wrong, strict=True):
                counts = Counter(each)
                decided, mistaken = sum(counts[w] for w in BOTH), sum(counts[w] for w in wrong)
                cells.append(f"{100 * mistaken / studies:.1f} of {100 * decided / studies:.0f}")
            rows.append((name, str(runs), *cells))
    print(f"wrong verdicts, of verdicts [% of {studies} studies]; up to {failing:.0%} may fail")
    print(table(("truth", "runs", *CLAIMS), rows))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=400)
    parser.add_argument("--failing", type=float, default=Rules().failing)
    parser.add_argument("--runs", type=int, nargs="+", default=RUNS)
    arguments = parser.parse_args()
    main(arguments.studies, arguments.failing, arguments.runs)
