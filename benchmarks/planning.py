"""What the physics allows: planning on the true model, beside the policies that ship.

    python benchmarks/planning.py --episodes 10 --task move_to_pose

Predictive sampling (Howell et al. 2022, arXiv 2212.00541): at every replanning, many copies of the
robot are simulated for a while, half of them with the last plan and coloured noise, half with the
scripted policy and such noise; the drives of the best copy are carried out. It sees the true
state and simulates the true physics, which no agent can: a reference, not a rival.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jbrep.envs.description import as_task
from jbrep.envs.task import Array
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import EPISODE_STEPS, TASKS, JitterbugTask
from jbrep.play.sources import find_player

COPIES, HORIZON, HELD = 16, 80, 10  # robots; steps that they look ahead; steps until replanning
TAIL, BEYOND = 20, 100  # the mean reward of the last steps counts for so many beyond the horizon
SIGMA, KEEP = 0.4, 0.8  # of the noise on drives, and how much of it stays from step to step


class Planned(NamedTuple):
    """An episode that was planned."""

    planned: float  # its return
    written: float  # that of the scripted policy from the same start
    trained: float  # that of the trained policy that ships
    seconds: float  # of CPU time, which planning took
    steps: int  # of robots that were simulated


class Planner:
    """Chooses drives by simulating copies of a robot."""

    def __init__(self, task: JitterbugTask, copies: int, horizon: int, seed: int):
        self.copies, self.horizon, self.steps = copies, horizon, 0
        self._policy = HEURISTICS[task.name]
        self._robots = Simulation(task, copies)
        self._random = np.random.default_rng(seed)
        self._plan = np.zeros(horizon)

    def drives(self, state: dict[str, Array], count: int) -> Array:
        """The next drives of a robot in that state, (count,)."""
        robots, copies = self._robots, self.copies
        robots.restore(**{name: np.repeat(each, copies, 0) for name, each in state.items()})
        noise, rewards = np.zeros((copies, 1)), np.empty((self.horizon, copies))
        quiet = np.ones((copies, 1))
        quiet[[0, copies // 2]] = 0  # the last plan, and the scripted policy, as they are
        taken = np.empty((self.horizon, copies))
        for step in range(self.horizon):
            noise = KEEP * noise + np.sqrt(1 - KEEP**2) * SIGMA * self._random.normal(
                size=noise.shape
            )
            drive = self._policy(robots.observe())
            drive[: copies // 2] = self._plan[step]
            drive = np.clip(drive + quiet * noise, -1, 1)
            diverged = robots.step(drive)
            rewards[step] = np.where(diverged, -np.inf, robots.reward())
            taken[step] = drive[:, 0]
        self.steps += self.horizon * copies
        value = rewards.sum(axis=0) + BEYOND * rewards[-TAIL:].mean(axis=0)
        best = taken[:, int(value.argmax())]
        self._plan = np.concatenate((best[count:], np.zeros(count)))
        return best[:count]


def plan(task: JitterbugTask, seed: int, copies: int, horizon: int, held: int) -> Planned:
    """Play an episode by planning, and by both policies that ship."""
    began, robot = time.process_time(), Simulation(task, 1, 1)
    robot.reset([0], [np.random.default_rng(seed)])
    planner, planned = Planner(task, copies, horizon, seed), 0.0
    for step in range(0, EPISODE_STEPS, held):
        for drive in planner.drives(robot.state, held)[: EPISODE_STEPS - step]:
            robot.step(np.array([[drive]]))
            planned += float(robot.reward()[0])
    seconds = time.process_time() - began
    written = play(task, seed, HEURISTICS[task.name])
    spec = as_task(task.name)
    trained = play(task, seed, find_player("trained", spec).begin(spec, [seed]))
    return Planned(planned, written, trained, seconds, planner.steps)


def play(task: JitterbugTask, seed: int, act: Callable[[Array], Array]) -> float:
    """What a policy returns from that start."""
    robot, total = Simulation(task, 1, 1), 0.0
    robot.reset([0], [np.random.default_rng(seed)])
    for _ in range(EPISODE_STEPS):
        robot.step(act(robot.observe()))
        total += float(robot.reward()[0])
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--task", nargs="*", default=list(TASKS))
    for name, default in (
        ("episodes", 10),
        ("copies", COPIES),
        ("horizon", HORIZON),
        ("held", HELD),
    ):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    print(
        f"returns of {given.episodes} episodes, median [least, most]; {given.copies} copies look "
        f"{given.horizon} steps ahead every {given.held} steps\n"
    )
    print("| task | planned | scripted | trained | CPU minutes an episode | robot-steps a step |")
    print("|---|---|---|---|---|---|")
    for name in given.task:
        each = [
            plan(TASKS[name], seed, given.copies, given.horizon, given.held)
            for seed in range(given.episodes)
        ]
        columns = np.array(each).T
        cells = [f"{np.median(c):.0f} [{c.min():.0f}, {c.max():.0f}]" for c in columns[:3]]
        minutes, cost = columns[3].mean() / 60, columns[4].mean() / EPISODE_STEPS
        print(f"| {name} | {' | '.join(cells)} | {minutes:.1f} | {cost:.0f} |", flush=True)


if __name__ == "__main__":
    main()
