"""Returns of the scripted policies and of random drive: python benchmarks/heuristics.py."""

import numpy as np

from jbrep.envs import Environments, describe
from jbrep.envs.recording import outcome
from jbrep.envs.task import Array
from jbrep.jitterbug.heuristics import HEURISTICS

EPISODES = 50


def main() -> None:
    random = np.random.default_rng(0)

    def uniform(observation: Array) -> Array:
        return random.uniform(-1, 1, (len(observation), 1))

    print(f"return of {EPISODES} episodes, seeds 0 to {EPISODES - 1}: median [10 %, 90 %]\n")
    print(f"| {'task':18} | {'scripted':16} | {'uniform random':16} |\n|---|---|---|")
    for task, policy in HEURISTICS.items():
        cells = []
        for candidate in (policy, uniform):
            low, median, high = np.percentile(
                outcome(Environments(describe(task), EPISODES), candidate).returns, (10, 50, 90)
            )
            cells.append(f"{median:.0f} [{low:.0f}, {high:.0f}]")
        print(f"| {task:18} | {cells[0]:16} | {cells[1]:16} |", flush=True)


if __name__ == "__main__":
    main()
