"""How long a run takes, from a short try."""

import time
from dataclasses import replace
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from jbrep.dae.training import single_torch_thread
from jbrep.encoders import find
from jbrep.rl.agent import Evaluator, make_agent, make_env
from jbrep.rl.presets import ALGORITHMS, get_preset
from jbrep.rl.run import Run

_LEAST_STEPS = 300


def estimate(run: Run) -> float:
    """Seconds that a run takes on one core of this machine, if nothing else is on it."""
    encoder = find(run.encoder, run.task)
    preset = get_preset(run.preset, run.algorithm)
    settings: dict[str, Any] = {**preset.settings}
    rollout = settings.get("train_freq", settings.get("n_steps", 1) * preset.num_envs)
    if issubclass(ALGORITHMS[run.algorithm], OffPolicyAlgorithm):
        settings["learning_starts"] = 0  # with gradient steps from the first rollout on
    agent = make_agent(
        run.algorithm,
        replace(preset, settings=settings),
        make_env(run.task, preset.num_envs, 0, encoder),
        0,
    )
    with single_torch_thread():
        began = time.perf_counter()
        agent.learn(max(rollout, _LEAST_STEPS))
        learned = time.perf_counter()
        Evaluator(run.task, encoder, run.evaluation_episodes).returns(agent)
        evaluated = time.perf_counter()
    evaluations = run.steps // run.evaluate_every + 1
    per_step = (learned - began) / agent.num_timesteps
    return run.steps * per_step + evaluations * (evaluated - learned)
