"""Search over the constants of a scripted policy with CMA-ES.

python tools/tune_heuristics.py move_to_position --minutes 30

Every few generations it prints the constants at the centre of the search, and the return that they
get on episodes that the search does not see. A constant is searched in proportion: 0 stays 0.
"""

import argparse
import inspect
import time
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import cma
import numpy as np

from jbrep.envs import Environments, describe
from jbrep.envs.recording import outcome
from jbrep.jitterbug.heuristics import HEURISTICS

SEARCH_EPISODES, TEST_EPISODES = 24, 50
TEST_SEED = 1_000_000
SPREAD = 0.2  # of a constant, relative to its size
REPORT_EVERY = 3  # generations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=HEURISTICS)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()

    policy = HEURISTICS[arguments.task]
    gaits = {
        name: parameter.default
        for name, parameter in inspect.signature(policy).parameters.items()
        if parameter.default is not parameter.empty
    }

    task = describe(arguments.task)
    search_envs, test_envs = (
        Environments(task, SEARCH_EPISODES),
        Environments(task, TEST_EPISODES),
    )

    def with_factors(factors: np.ndarray) -> dict[str, Any]:
        factor = iter(factors)
        return {
            name: replace(gait, **{key: float(x * next(factor)) for key, x in asdict(gait).items()})
            for name, gait in gaits.items()
        }

    def score(factors: np.ndarray, seed: int) -> float:
        candidate = partial(policy, **with_factors(factors))
        returns = outcome(search_envs, candidate, seed).returns
        return float(np.median(returns) + np.mean(returns)) / 2

    size = sum(len(asdict(gait)) for gait in gaits.values())
    search = cma.CMAEvolutionStrategy(
        np.ones(size), SPREAD, {"seed": arguments.seed, "verbose": -9}
    )
    end = time.monotonic() + 60 * arguments.minutes
    while time.monotonic() < end:
        candidates = search.ask()
        seed = search.countiter * SEARCH_EPISODES  # all candidates of a generation start alike
        search.tell(candidates, [-score(candidate, seed) for candidate in candidates])
        if search.countiter % REPORT_EVERY == 0:
            constants = with_factors(search.mean)
            test = outcome(test_envs, partial(policy, **constants), TEST_SEED).returns
            low, median, high = np.percentile(test, (10, 50, 90))
            print(
                f"generation {search.countiter}: {median:.0f} [{low:.0f}, {high:.0f}] {constants}"
            )


if __name__ == "__main__":
    main()
