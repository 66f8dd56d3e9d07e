"""How fast an agent alone learns with other settings: python benchmarks/settings.py.

Rates against those of `wide`, in rounds taken in turn, on two threads. *beside* steps the robots in
a thread while the gradient steps are taken, whose policy is then one call older.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnvWrapper
from timing import show, timed

from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.rl.agent import make_agent, make_env
from jbrep.rl.overrides import overridden

TASK, ROUNDS, CALLS, WARM_UP = "move_to_position", 8, 25, 640
SMALL = {"net_arch": [64, 64], "batch_size": 256}
SETTINGS: dict[str, dict[str, Any]] = {
    "two layers of 64, batches of 256": SMALL,
    "batches of 256": {"batch_size": 256},
    "two layers of 64": {"net_arch": [64, 64]},
    "two layers of 64, batches of 256, 16 gradient steps": {**SMALL, "gradient_steps": 16},
}


class Beside(VecEnvWrapper):
    """Environments that step while their agent takes its gradient steps."""

    agent: Any
    gradient_steps: int
    result: Future[Any]

    def __init__(self, venv: Any):
        super().__init__(venv)
        self.pool = ThreadPoolExecutor(1)

    def reset(self) -> Any:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(actions)
        self.result = self.pool.submit(self.venv.step_wait)

    def step_wait(self) -> Any:
        if self.agent.num_timesteps > WARM_UP:
            self.agent.train(self.gradient_steps, self.agent.batch_size)
        return self.result.result()


def learner(overrides: dict[str, Any], is_beside: bool = False) -> Callable[[], float]:
    """Seconds for a control step, each time it is called; it has begun to learn."""
    torch.set_num_threads(1)
    task = describe(TASK)
    chosen = overridden("sac", "wide", {"learning_starts": WARM_UP, **overrides})
    inner = make_env(task, chosen, 0, find("symmetry", task), 2)
    env = Beside(inner) if is_beside else inner
    agent: Any = make_agent("sac", chosen, env, 0)
    if isinstance(env, Beside):
        env.agent, env.gradient_steps, agent.gradient_steps = agent, agent.gradient_steps, 0
    agent.learn(2 * WARM_UP)
    steps = CALLS * chosen.num_envs

    def seconds() -> float:
        work = timed(lambda: agent.learn(steps, reset_num_timesteps=False))
        return work / steps / chosen.action_repeat

    return seconds


def main() -> None:
    others = {name: learner(overrides) for name, overrides in SETTINGS.items()}
    others["robots beside gradient steps"] = learner({}, is_beside=True)
    others["the same, two layers of 64, batches of 256"] = learner(SMALL, is_beside=True)
    wide, rates = learner({}), {name: list[float]() for name in others}
    for _ in range(ROUNDS):
        usual = wide()
        for name, other in others.items():
            rates[name].append(usual / other())
    for name, values in rates.items():
        show(f"{name}, rate against wide", values)


if __name__ == "__main__":
    main()
