"""How long a run takes, estimated from a short trial."""

import time
from dataclasses import replace
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from jbrep.rl.agent import Evaluator, make_agent, make_env
from jbrep.rl.presets import ALGORITHMS
from jbrep.rl.run import Run
from jbrep.training.trainer import single_torch_thread

_MIN_STEPS = 300


def estimate(run: Run) -> float:
    """Seconds that a run takes on one core of this machine with nothing else running."""
    encoder = run.find_encoder()
    preset = run.used
    settings: dict[str, Any] = {**preset.settings}
    if issubclass(ALGORITHMS[run.algorithm], OffPolicyAlgorithm):
        settings["learning_starts"] = 0  # gradient steps from the first rollout on
    env = make_env(run.task, preset.num_envs, 0, encoder, preset.normalize)
    agent = make_agent(run.algorithm, replace(preset, settings=settings), env, 0)
    evaluator = Evaluator(run.task, encoder, run.evaluation_episodes)
    with single_torch_thread():
        started = time.perf_counter()
        agent.learn(_MIN_STEPS)  # whole rollouts, so at least one
        learned = time.perf_counter()
        evaluator.returns(agent)
        evaluated = time.perf_counter()
    evaluations = run.steps // run.evaluate_every + 1
    per_step = (learned - started) / agent.num_timesteps
    return run.steps * per_step + evaluations * (evaluated - learned)
