"""What a training run is: task, learner, representation, seed, how it is trained, how long."""

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from math import gcd
from pathlib import Path
from typing import Any

from msgspec import UNSET

from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.description import as_task
from jbrep.envs.environments import envs_at_once
from jbrep.envs.names import is_code
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.record import Sha256, to_plain
from jbrep.rl.agent import evaluate, make_agent, make_env
from jbrep.rl.learner import Learner
from jbrep.rl.policy import policy_to_begin_with
from jbrep.rl.presets import ALGORITHMS, usual_preset
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.settings import MAX_EPISODES, Name, Seed, TrainingSettings
from jbrep.training.trainer import get_device, single_torch_thread

_EVALUATIONS = 10  # before the last, where a run doesn't say
_APART = 10_000  # steps between them, at least
_FINAL = 10  # times as many episodes in the last evaluation
_TRIAL = 300  # steps from which the time of a run is estimated


class Run(TrainingSettings, frozen=True, kw_only=True):
    """What to train."""

    task: Task  # what is learned
    learner: Learner  # the algorithm with its hyperparameters
    # through which the agent observes: a name or file, code, or a user's own encoder, as
    # `jbrep.encoders.find` takes it
    encoder: Any = FULL
    seed: Seed = 0  # of agent and episodes
    # what tables call it that the agent observes; the encoder's own name by default
    representation: Name | None = None
    encoder_seed: Seed | None = None  # that the encoder was made with, if each run has its own
    begin_from: str = ""  # the folder of a finished run, whose policy this one begins with
    registration: Sha256 | None = None  # SHA-256 of that of its study, if that is registered
    # whether there is one instance of the environment, as of a robot that exists once
    one_robot: bool = False

    @classmethod
    def of(
        cls,
        task: Task | str,
        algorithm: str = "sac",
        preset: str = "",
        overrides: Mapping[str, Any] = {},
        **others: Any,
    ) -> "Run":
        """A run of a task with an algorithm of stable-baselines3's, such as sac.

        The preset is paper, modern, wide, or a TOML file; if empty, that which serves a newcomer
        best. Overrides are hyperparameters that are set differently; others are fields of a run.
        """
        learner = Learner.given(algorithm, preset or usual_preset(algorithm), overrides)
        return cls(task=as_task(task), learner=learner, **others)

    def find_encoder(self) -> BaseEncoder:
        """The encoder."""
        with single_torch_thread():  # as in training, so that a module computes the same bits
            return find(self.encoder, self.task)

    def settings(self, encoder: BaseEncoder) -> RunSettings:
        """All settings that two equal runs share, given what `find_encoder` returns."""
        repeat, most = self.learner.hyperparameters.action_repeat, self.task.max_episode_steps
        if repeat > most:
            raise InputError(f"action_repeat is {repeat}: an episode has {most} steps alone")
        is_kept_as_code = is_code(self.encoder) and not isinstance(encoder, Encoder)
        shared = to_plain(self.training_settings) | {
            "device": get_device(self.device).type,
            "evaluate_every": self.evaluate_every or max(self.steps // _EVALUATIONS, _APART),
            "final_episodes": self.final_episodes
            or min(_FINAL * self.evaluation_episodes, MAX_EPISODES),
        }
        settings = RunSettings(
            task=self.task.name,
            environment=self.task,
            algorithm=self.learner.algorithm,
            preset=self.learner.preset,
            overrides=self.learner.overrides,
            learner=self.learner.name,
            hyperparameters=self.learner.hyperparameters.within(self.steps),
            representation=self.representation or encoder.name,
            encoder=encoder.fingerprint,
            encoder_code=str(self.encoder) if is_kept_as_code else None,
            encoder_seed=self.encoder_seed,
            seed=self.seed,
            begin_from=None,
            registration=self.registration,
            one_robot=self.one_robot or UNSET,
            **shared,
        )
        if not self.begin_from:
            return settings
        sha256 = policy_to_begin_with(Path(self.begin_from), settings, encoder.latent_size)
        return settings.replace(begin_from=sha256)


def estimate(run: Run) -> float:
    """Seconds that a run takes on one core of this machine with nothing else running."""
    if ALGORITHMS[run.learner.algorithm].learns_off_policy:
        run = run.replace(learner=run.learner.overridden(_at_once(run)))
    encoder = run.find_encoder()
    settings = run.settings(encoder)
    chosen, episodes = settings.hyperparameters, run.evaluation_episodes
    made = make_env(run.task, chosen, 0, encoder)
    with single_torch_thread(), closing(made) as env, ExitStack() as opened:
        agent = make_agent(settings.algorithm, chosen, env, 0, settings.episode_steps)
        learning = _seconds(lambda: agent.learn(_TRIAL))  # whole rollouts, so at least one
        envs = opened.enter_context(envs_at_once(run.task, episodes, 1, 0))
        evaluation = _seconds(lambda: evaluate(agent, envs, encoder, episodes))
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
