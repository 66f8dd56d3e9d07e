"""How often verdicts are wrong, where the truth is known: python benchmarks/verdicts.py.

Studies of two representations are made up and judged. Returns of runs are normally distributed,
skewed, or of runs of which some learn and others don't; what a seed draws is shared by both sides.
A verdict is wrong if it supports what isn't so, or contradicts what is; on the boundary of a claim
any verdict is. Once `better` is tested alone, and once `not worse`, `faster` and `less variable`
one after the other.
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
from jbrep.stats import claims
from jbrep.stats.bootstrap import Interval
from jbrep.stats.claims import BETTER, CLAIMS, CONTRADICTED, SUPPORTED
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import RunCurve
from jbrep.text import table

# verdicts come from p-values and the side of the boundary; intervals would take most of the time
_claims: Any = claims
_claims.ratio_of_spreads = lambda curves, *how: Interval(
    np.exp(claims._excess(curves, 0.0)), np.nan, np.nan
)
_spread_p = partial(claims.spread_p, permutations=999)  # in place of ten times as many

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator, Array], Array]  # final returns, from what seeds share
RUNS = (8, 16, 32)
STEPS = np.arange(0, 100_001, 5_000)
STILL, TOP, MOST = 250.0, 880.0, 1000.0
BOTH = (SUPPORTED, CONTRADICTED)
TASK, ALGORITHM, X, Y = "task", "algorithm", "x", "y"


class Truth(NamedTuple):
    """How runs end on either representation, and which verdicts on each claim are wrong."""

    y: Draw
    x: Draw
    wrong: tuple[tuple[str, ...], ...]  # by claim, in their order


def normal(mean: float, sd: float = 40) -> Draw:
    return lambda random, shared: mean + sd * (shared + random.normal(size=len(shared))) / 2**0.5


def skewed(mean: float, scale: float = 40) -> Draw:
    """Most near the top, some far below."""
    return lambda random, shared: mean + scale * (2 - random.gamma(2, 1, len(shared)))


def failing(share: float, learnt: float = TOP) -> Draw:
    """Runs that learn, and runs that stand still."""

    def draw(random: np.random.Generator, shared: Array) -> Array:
        ends = normal(learnt, 30)(random, shared)
        return np.where(random.random(len(ends)) < share, random.normal(STILL, 15, len(ends)), ends)

    return draw


def failing_from(share: float, mean: float) -> Draw:
    """The same with a mean that is given."""
    return failing(share, (mean - share * STILL) / (1 - share))


ON_MARGIN = STILL + 0.9 * (TOP - STILL)
LOWER = STILL + 0.5 * (TOP - STILL)
EQUAL = (BOTH, (CONTRADICTED,), BOTH, BOTH)
LESS = ((SUPPORTED,), BOTH, (SUPPORTED,), BOTH)
WORSE = ((SUPPORTED,), (SUPPORTED,), (SUPPORTED,), BOTH)
MORE = ((CONTRADICTED,), (CONTRADICTED,), (CONTRADICTED,), BOTH)
LIKE = (BOTH, (CONTRADICTED,), (), ())  # equal means of other distributions
TRUTHS = {
    "normal, equal": Truth(normal(TOP), normal(TOP), EQUAL),
    "normal, lower by the margin": Truth(normal(TOP), normal(ON_MARGIN), LESS),
    "normal, higher by a tenth": Truth(normal(ON_MARGIN), normal(TOP), MORE),
    "skewed, equal": Truth(skewed(TOP), skewed(TOP), EQUAL),
    "skewed, lower by the margin": Truth(skewed(TOP), skewed(ON_MARGIN), LESS),
    "a fifth fails on both": Truth(failing(0.2), failing(0.2), EQUAL),
    "a fifth fails on x": Truth(normal(TOP), failing(0.2), WORSE),
    "a ninth fails on x": Truth(normal(TOP), failing(0.11), WORSE),
    "a ninth fails on x, equal means": Truth(normal(LOWER), failing_from(0.11, LOWER), LIKE),
    "a ninth fails on y, equal means": Truth(failing_from(0.11, LOWER), normal(LOWER), LIKE),
    "all fail on both": Truth(failing(1), failing(1), (BOTH,) * 4),
}


def study(truth: Truth, runs: int, seed: int) -> dict[str, list[RunCurve]]:
    """Made-up runs that rise around the middle of training."""
    random = np.random.default_rng(seed)
    shared = random.standard_normal(runs)

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
            top=TOP,
        )

    sides = ((Y, truth.y), (X, truth.x))
    return {
        name: [curve(name, i, end) for i, end in enumerate(draw(random, shared).clip(0, MOST))]
        for name, draw in sides
    }


def judged(name: str, runs: int, seed: int) -> tuple[str, ...]:
    """The verdicts on a made-up study."""
    _claims.spread_p = partial(_spread_p, seed=seed)  # independent from study to study
    group, alone = study(TRUTHS[name], runs, seed), [BETTER.name]
    found = []
    for chain in (alone, [each for each in CLAIMS if each not in alone]):
        rules = Rules(claims=tuple(f"{X} {each} than {Y}" for each in chain))
        planned = Planned(rules, tuple(range(runs)), ((TASK, ALGORITHM),))
        found += [each.verdict for each in planned({(TASK, ALGORITHM): group})]
    return tuple(found)


def main(studies: int, sizes: Sequence[int]) -> None:
    rows = []
    with ProcessPoolExecutor() as pool:
        for name, runs in Progress([(name, n) for name in TRUTHS for n in sizes], unit="case"):
            found = [*pool.map(partial(judged, name, runs), range(studies), chunksize=8)]
            cells = []
            for each, wrong in zip(zip(*found, strict=True), TRUTHS[name].wrong, strict=True):
                counts = Counter(each)
                decided, mistaken = sum(counts[w] for w in BOTH), sum(counts[w] for w in wrong)
                cells.append(f"{100 * mistaken / studies:.1f} of {100 * decided / studies:.0f}")
            rows.append((name, str(runs), *cells))
    print(f"wrong verdicts, of verdicts [% of {studies} studies]")
    print(table(("truth", "runs", *CLAIMS), rows))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=400)
    parser.add_argument("--runs", type=int, nargs="+", default=RUNS)
    arguments = parser.parse_args()
    main(arguments.studies, arguments.runs)
