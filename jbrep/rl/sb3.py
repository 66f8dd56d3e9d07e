"""stable-baselines3 as the trainer of one run at a time, for all of its algorithms."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.noise import (
    ActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)

from jbrep.encoders.vec_env import JitterbugVecEnv
from jbrep.envs.lanes import EnvironmentFailedError, NonFiniteActionError
from jbrep.records.container import Tensors, without
from jbrep.rl import checkpoint
from jbrep.rl.action_noise import StatefulNoise
from jbrep.rl.agent import make_agent, make_env, training_seed, unchecked_distributions
from jbrep.rl.checkpoint import (
    ACTIONS_NOT_FINITE,
    LANES,
    WEIGHTS_NOT_FINITE,
    DivergedError,
    Snapshot,
    StoppedError,
)
from jbrep.rl.files import Episode, RunRecord
from jbrep.rl.job import Ended, Job, Session
from jbrep.rl.trained import acting

_MEMORIES: dict[type, str] = {  # of noises that depend on what was drawn before
    OrnsteinUhlenbeckActionNoise: "noise_prev",
    StatefulNoise: "memory",
}
_UNSCALED = "_last_original_obs"  # before it was normalised
_EXPLORATION = ("exploration_mat", "exploration_matrices")
_TRANSITIONS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def train_in_turn(jobs: Sequence[Job], session: Session) -> Iterator[Ended]:
    """Bring runs from their start or their checkpoints to their end, one after the other.

    Raises:
        StoppedError: the session is to stop; the run's checkpoint is written.
    """
    return ((job, _train(job, session)) for job in jobs)


def _train(job: Job, session: Session) -> RunRecord:
    run, settings = job.run, job.settings
    chosen, follower = settings.hyperparameters, _Follower(job, session)
    job.keep_encoder()
    seed = training_seed(run.seed)
    lanes = chosen.num_envs
    made = make_env(
        run.task,
        lanes,
        seed,
        job.encoder,
        normalize=chosen.normalize,
        num_threads=job.threads_for(lanes),
        action_repeat=chosen.action_repeat,
        retries=job.retries,
    )
    with (
        closing(made) as env,
        closing(job),
    ):
        agent = make_agent(settings.algorithm, chosen, env, run.seed, settings.episode_steps)
        env.seed(seed)  # stable-baselines3 gave it the agent's, which lanes of other runs share
        job.prepare(agent, session.writers)
        job.share(_env(agent).lanes)
        failed = _learn(agent, settings.agent_steps, follower)
        return job.end(agent, failed, session.keep_checkpoint)


def _learn(agent: BaseAlgorithm, steps: int, callback: BaseCallback) -> Exception | None:
    """Train up to that step; why training failed, if it did."""
    try:
        with unchecked_distributions():
            agent.learn(steps, callback=callback)
    except (DivergedError, EnvironmentFailedError) as error:
        return error
    except NonFiniteActionError:
        return DivergedError(ACTIONS_NOT_FINITE)
    finally:
        agent.logger.close()
    return None


class _Follower(BaseCallback):
    """Records an agent's training, evaluates its policy, and keeps its checkpoint.

    The policy is evaluated before the first step, after the last, and at intervals in between.
    Training goes on from the run's snapshot, if there is one. Another is taken now and then between
    rollouts, where an agent's state is complete.

    Raises:
        StoppedError: (in training) the session is to stop; the checkpoint is written.
    """

    def __init__(self, job: Job, session: Session):
        super().__init__()
        self._job, self._session = job, session
        self._snapshot = job.checkpoint.read()
        self._draws: Tensors = {}  # of the snapshot, until the first rollout

    def _on_training_start(self) -> None:
        if self._snapshot:
            self._draws = self._snapshot.tensors
            with self._job.checkpoint.resuming():
                restore(self.model, self._snapshot)
            self._snapshot = None  # a replay buffer can be large

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if not self._job.history.evaluations:
            self._evaluate(self.model._last_obs)
        self._tell()
        if self._draws:  # state-dependent noise has just been drawn, for the second time
            _restore_draws(self.model, self._draws)
            self._draws = {}
        stopping, file = self._session.stop(), self._job.checkpoint
        if stopping or file.is_due(self._session.save_every):
            file.write(take(self.model))
        if stopping:
            raise StoppedError(self._job.step_of(self.model))

    def _on_step(self) -> bool:
        step = self._job.step_of(self.model)
        for lane in np.flatnonzero(self.locals["dones"]).tolist():
            info = self.locals["infos"][lane]
            total, length = float(info["episode"]["r"]), info["control_steps"]
            row = Episode(step, lane, total, length, info.get("non_finite", False))
            self._job.history.episodes.append(row)
        episode_ended = bool(self.locals["dones"].any())
        if self._job.is_evaluation_due(step, episode_ended, self._session.keep_checkpoint):
            self._evaluate(self.locals["new_obs"])
        return True

    def _evaluate(self, observed: Any) -> None:
        """Evaluate, with one robot between episodes: the next one begins once more.

        Args:
            observed: its first observation as the agent is to see it, (1, l).
        """
        self._job.evaluate(self.model)
        if self._job.run.one_robot:
            first: Any = _env(self.model).restart()
            if normalizer := self.model.get_vec_normalize_env():
                normalizer.old_obs = first
                if observed is self.model._last_obs:  # else the transition isn't stored yet
                    setattr(self.model, _UNSCALED, first.copy())
                first = normalizer.normalize_obs(first)
            observed[:] = first

    def _on_training_end(self) -> None:
        check_finite(self.model)
        self._tell()  # the last evaluation can take minutes
        if self._session.keep_checkpoint:
            if not self._draws:  # else nothing was trained since, and it is drawn
                _draw_noise(self.model)
            self._job.checkpoint.write(take(self.model))
        self._job.final_evaluation(self.model)
        self._tell()

    def _tell(self) -> None:
        self._session.watch(self._job, self._job.step_of(self.model))


def check_finite(agent: BaseAlgorithm) -> None:
    """Check the last losses and the policy's weights.

    Raises:
        DivergedError: one is NaN or infinite.
    """
    for name, value in agent.logger.name_to_value.items():
        if name.endswith("loss") and not np.isfinite(value):
            raise DivergedError(f"{name} is {value}")
    if not all(bool(torch.isfinite(p.sum())) for p in acting(agent.policy).parameters()):
        raise DivergedError(WEIGHTS_NOT_FINITE)


def take(agent: BaseAlgorithm) -> Snapshot:
    """Take a snapshot of an agent between two rollouts; its tensors share the agent's memory."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 - SB3 draws there
    tensors, counters = checkpoint.take(agent)
    tensors |= {f"{LANES}{name}": values for name, values in _env(agent).state.items()}
    tensors |= {name: getattr(*place) for name, place in _arrays(agent).items()}
    tensors |= {"torch": torch.get_rng_state().numpy(), "numpy": np.asarray(keys)}
    if noise := _state_dependent_noise(agent):
        tensors |= {name: getattr(noise, name).detach().numpy() for name in _EXPLORATION}
    counters |= {
        "numpy": (kind, position, has_gauss, gauss),
        "action_space": agent.action_space.np_random.bit_generator.state,
    }
    if buffer := _buffer(agent):
        counters["buffer"] = (buffer.pos, buffer.full)
        tensors |= {f"buffer.{name}": values for name, values in _transitions(buffer).items()}
    return Snapshot(tensors, counters)


def restore(agent: BaseAlgorithm, snapshot: Snapshot) -> None:
    """Bring an agent that is set up to learn to where the snapshot was taken."""
    checkpoint.restore(agent, snapshot)
    tensors, counters = snapshot
    if buffer := _buffer(agent):
        buffer.pos, buffer.full = counters["buffer"]
        for name, values in _transitions(buffer).items():
            values[:] = tensors[f"buffer.{name}"]
    for name, place in _arrays(agent).items():
        setattr(*place, tensors[name])
    _env(agent).restore(without(LANES, tensors))
    agent.action_space.np_random.bit_generator.state = counters["action_space"]
    _restore_draws(agent, tensors)
    kind, *rest = counters["numpy"]
    np.random.set_state((kind, tensors["numpy"], *rest))  # noqa: NPY002


def _arrays(agent: BaseAlgorithm) -> dict[str, tuple[object, str]]:
    """Which arrays decide how a rollout goes on: the object that has each, and its attribute."""
    normalizer = agent.get_vec_normalize_env()
    monitor = normalizer.venv if normalizer else agent.env
    last = ("_last_obs", "_last_episode_starts")
    places: dict[str, tuple[object, str]] = {f"rollout.{name}": (agent, name) for name in last}
    if normalizer:
        places[_UNSCALED] = agent, _UNSCALED
    for i, noise in enumerate(_noises(agent)):
        if memory := _MEMORIES.get(type(noise)):
            places[f"noise.{i}"] = noise, memory
    return places | {
        "returns": (monitor, "episode_returns"),
        "lengths": (monitor, "episode_lengths"),
    }


def _restore_draws(agent: BaseAlgorithm, tensors: Tensors) -> None:
    """Bring torch's generator, and what was drawn from it last, to where they were."""
    torch.set_rng_state(torch.from_numpy(tensors["torch"]))
    if noise := _state_dependent_noise(agent):
        for name in _EXPLORATION:
            setattr(noise, name, torch.from_numpy(tensors[name]))


def _draw_noise(agent: BaseAlgorithm) -> None:
    """Draw state-dependent noise, if there is any, as the next rollout would at its start."""
    if _state_dependent_noise(agent):
        policy: Any = acting(agent.policy)
        policy.reset_noise(agent.n_envs)


def _state_dependent_noise(agent: BaseAlgorithm) -> StateDependentNoiseDistribution | None:
    """The distribution that explores by noise on features, with use_sde."""
    distribution = getattr(acting(agent.policy), "action_dist", None)
    is_one = isinstance(distribution, StateDependentNoiseDistribution)
    return distribution if is_one else None


def _env(agent: BaseAlgorithm) -> JitterbugVecEnv:
    env = agent.env.unwrapped if agent.env else None
    assert isinstance(env, JitterbugVecEnv)
    return env


def _buffer(agent: BaseAlgorithm) -> ReplayBuffer | None:
    return getattr(agent, "replay_buffer", None)


def _transitions(buffer: ReplayBuffer) -> dict[str, NDArray[Any]]:
    """Views of the filled part of the buffer."""
    size = buffer.buffer_size if buffer.full else buffer.pos
    return {name: getattr(buffer, name)[:size] for name in _TRANSITIONS}


def _noises(agent: BaseAlgorithm) -> list[ActionNoise]:
    """The action noise of each lane, if there is any."""
    noise = getattr(agent, "action_noise", None)
    return noise.noises if isinstance(noise, VectorizedActionNoise) else [noise] if noise else []
