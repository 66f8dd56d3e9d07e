"""How long a run takes, estimated from a short trial."""

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from math import gcd

from jbrep.envs.lanes import lanes_at_once
from jbrep.rl.agent import Evaluator, make_agent, make_env
from jbrep.rl.overrides import is_off_policy
from jbrep.rl.run import Run
from jbrep.training.trainer import single_torch_thread

_MIN_STEPS = 300


def estimate(run: Run) -> float:
    """Seconds that a run takes on one core of this machine with nothing else running."""
    if is_off_policy(run.learner.algorithm):
        run = run.replace(learner=run.learner.overridden(_at_once(run)))
    encoder = run.find_encoder()
    settings = run.settings(encoder)
    chosen, episodes = settings.hyperparameters, run.evaluation_episodes
    made = make_env(
        run.task,
        chosen.num_envs,
        0,
        encoder,
        normalize=chosen.normalize,
        action_repeat=chosen.action_repeat,
    )
    with single_torch_thread(), closing(made) as env, ExitStack() as opened:
        agent = make_agent(settings.algorithm, chosen, env, 0, settings.episode_steps)
        learning = _seconds(lambda: agent.learn(_MIN_STEPS))  # whole rollouts, so at least one
        lanes = opened.enter_context(lanes_at_once(run.task, episodes, 1, 0))
        evaluation = _seconds(lambda: Evaluator(lanes, encoder, episodes).outcome(agent))
        taken = settings.control_steps(agent.num_timesteps)
    count = run.steps // settings.evaluate_every + settings.final_episodes / episodes
    return run.steps * learning / taken + count * evaluation


def _at_once(run: Run) -> dict[str, int]:
    """Settings with gradient steps from the first rollout on, in rollouts as short as can be."""
    used = run.learner.hyperparameters.algorithm_kwargs
    every, many = used.get("train_freq"), used.get("gradient_steps")
    if type(every) is not int or type(many) is not int or many < 1:
        return {"learning_starts": 0}
    every, many = every // gcd(every, many), many // gcd(every, many)
    return {"learning_starts": 0, "train_freq": every, "gradient_steps": many}


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
