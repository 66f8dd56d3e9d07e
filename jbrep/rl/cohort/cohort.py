"""Runs of one task and algorithm that learn side by side, each as it would alone."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import Tensor

from jbrep.encoders.base import Float32
from jbrep.envs.autoreset import AutoresetLanes
from jbrep.envs.task import Array
from jbrep.records.container import without
from jbrep.rl.agent import training_seed
from jbrep.rl.checkpoint import ACTIONS_NOT_FINITE, LANES, DivergedError, Snapshot
from jbrep.rl.cohort import get_algorithm
from jbrep.rl.cohort.algorithm import Batch, Losses
from jbrep.rl.cohort.member import Member
from jbrep.rl.cohort.networks import Stack
from jbrep.rl.cohort.replay import ReplayBuffer, capacity_of
from jbrep.rl.job import Job

_REPLAY = "replay"  # the name of what a replay buffer holds, in a snapshot


class Cohort:
    """n members that act and learn at once.

    Args:
        members: which can learn together, see `jbrep.rl.cohort.trainer`.
        replay: theirs, if it is there.

    Attributes:
        members: which learn together.
        agent_step: of training, over the lanes of a member.
    """

    def __init__(self, members: Sequence[Member], replay: ReplayBuffer | None = None):
        job = members[0].job
        settings, task = job.settings, job.run.task
        self.members, self.agent_step, self._n_updates = members, 0, 0
        self._shared: Any = members[0].agent  # its settings are those of all
        self._settings, self._lanes = settings, settings.hyperparameters.num_envs
        self._size = padded_size(job)
        sizes = self._size, task.action_size
        looks = self._shared.n_steps, self._shared.gamma
        of_all = len(members), self._lanes, capacity_of(job.run)
        self._replay = replay or ReplayBuffer(*of_all, *sizes, *looks)
        self._device = torch.device(settings.device)
        agents = [member.agent for member in members]
        self._stack = Stack(agents, self._size, settings.precision, settings.device)
        self._algorithm = get_algorithm(settings.algorithm)(self._stack)
        self._stack.read_from_agents()
        lanes, repeat = len(members) * self._lanes, settings.hyperparameters.action_repeat
        self._robots = AutoresetLanes(task, lanes, job.threads_for(lanes), repeat, job.retries)
        job.share(self._robots.lanes)
        self._observation = np.zeros((len(members), self._lanes, self._size), np.float32)
        self._episode_ended = False  # whether an episode has just ended

    def begin(self) -> None:
        """Begin the first episodes.

        Raises:
            EnvironmentFailedError: as `act`.
        """
        lanes, jobs = range(self._lanes), [member.job for member in self.members]
        seeds = [training_seed(job.run.seed) + lane for job in jobs for lane in lanes]
        self._observation = self._encode(self._robots.reset(seeds))
        self._update_statistics()

    @property
    def step(self) -> int:
        """Training steps so far, in control steps."""
        return self._settings.control_steps(self.agent_step)

    @property
    def rollout(self) -> int:
        """How often the environments are stepped between gradient steps."""
        return int(self._shared.train_freq.frequency)

    def act(self) -> None:
        """Step every lane, and add its transition to the replay buffer.

        Raises:
            EnvironmentFailedError: an environment fails; `member_of` its lane says whose it is.
        """
        scaled = self._choose_actions()
        action = self._shared.policy.unscale_action(scaled)
        lanes = action.reshape(-1, action.shape[2]).astype(float)
        moved = self._robots.step(self._robots.lanes.task.unscale_action(lanes))
        self._episode_ended = bool(moved.ended.any())
        self.agent_step += self._lanes
        ended, terminated = self._by_member(moved.ended), self._by_member(moved.terminated)
        reward = self._by_member(moved.reward).astype(np.float32)
        observation = final = self._encode(moved.observation)
        if ended.any():
            final = np.where(ended[..., None], self._encode(moved.final), observation)
        flags = np.stack((ended & terminated, ended), axis=2)
        self._replay.add(self._observation, scaled, final, reward[..., None], flags)
        if moved.lost.any():
            self._replay.drop(self._by_member(moved.lost))
        self._observation = observation
        self._update_statistics()
        length, diverged = self._by_member(moved.length), self._by_member(moved.diverged)
        for member, *own in zip(self.members, reward, length, ended, diverged, strict=True):
            member.record(*own)

    def learn(self) -> None:
        """Take the gradient steps that follow a rollout."""
        if self.agent_step <= self._shared.learning_starts:
            return
        steps = self._shared.gradient_steps
        if steps < 0:  # as many as were collected
            steps = self.rollout * self._lanes
        rate = self._shared.lr_schedule(1 - self.agent_step / self._settings.agent_steps)
        self._stack.set_learning_rate(rate)
        self._log_losses([self.update(number) for number in range(steps)])

    def update(self, gradient_step: int) -> Losses:
        """Take a gradient step, by its number among those that follow a rollout, from 0."""
        self._n_updates += 1
        normals = self._normals(self._algorithm.normals_to_learn, self._shared.batch_size)
        return self._algorithm.update(self._sample(), normals, self._n_updates, gradient_step)

    def _sample(self) -> Batch:
        """Transitions of each member, its observations normalised as it sees them now."""
        filled, size = self._replay.filled, self._shared.batch_size
        indices = [member.random.sample_indices(filled, size) for member in self.members]
        steps, lanes = (np.stack(each) for each in zip(*indices, strict=True))
        observation, action, next_observation, *rest = self._replay.sample(steps, lanes)
        normalized = self._normalize(observation), action, self._normalize(next_observation)
        return Batch(*map(self._tensor, (*normalized, *rest)))

    def _choose_actions(self) -> Float32:
        """Actions scaled to [-1, 1], (n, lanes, k), rounded as stable-baselines3 rounds them."""
        policy = self._shared.policy
        if self.agent_step < self._shared.learning_starts:
            actions = np.stack([member.random.actions() for member in self.members])
        else:
            normals = self._normals(self._algorithm.normals_to_explore, self._lanes)
            observation = self._tensor(self._normalize(self._observation))
            with torch.no_grad():
                scaled = self._algorithm.explore(observation, normals)
            actions = policy.unscale_action(scaled.numpy(force=True))
            self._stop_at_non_finite(actions)
        noise = np.stack([member.random.noise() for member in self.members])
        return np.clip(policy.scale_action(actions) + noise, -1, 1)

    def _normals(self, count: int, rows: int) -> list[Tensor]:
        """So many draws of standard normal numbers, (n, rows, k) each."""
        (size,) = self._shared.action_space.shape
        draws = [[m.random.normal(rows, size) for _ in range(count)] for m in self.members]
        return [torch.stack(each).to(self._device) for each in zip(*draws, strict=True)]

    def _stop_at_non_finite(self, actions: Float32) -> None:
        """Let members fail whose actions aren't finite; they do nothing in this step."""
        wrong = ~np.isfinite(actions)
        for number in np.flatnonzero(wrong.any((1, 2))).tolist():
            self.members[number].fail(DivergedError(ACTIONS_NOT_FINITE))
        actions[wrong] = 0

    def _log_losses(self, losses: Sequence[Losses]) -> None:
        """Log the means of gradient steps, and let members fail where one isn't finite."""
        names = dict.fromkeys(name for each in losses for name in each)
        means = [torch.stack([x[name] for x in losses if name in x]).mean(0) for name in names]
        rows = torch.stack([*means, self._algorithm.actor_sum()], 1).tolist()
        for member, (*own, weights) in zip(self.members, rows, strict=True):
            member.log_losses(dict(zip(names, own, strict=True)), weights)

    def _encode(self, observation: Array) -> Float32:
        """What each member's encoder shows of each lane, padded with zeros, (n, lanes, size)."""
        encoded = np.zeros((len(self.members), self._lanes, self._size), np.float32)
        own = self._by_member(observation)
        for (member, rows), each in zip(self._unpadded(encoded), own, strict=True):
            rows[:] = member.encode(each)
        return encoded

    def _update_statistics(self) -> None:
        """Take the observations of now into the statistics that normalise."""
        for member, rows in self._unpadded(self._observation):
            member.update_statistics(rows)

    def _normalize(self, observation: Float32) -> Float32:
        """Encoded observations, (n, rows, size), normalised where settings say so."""
        normalized = observation.copy() if self._shared.get_vec_normalize_env() else observation
        for member, rows in self._unpadded(normalized):
            rows[:] = member.normalize(rows)
        return normalized

    def _unpadded(self, observation: Float32) -> Iterator[tuple[Member, Float32]]:
        """Each member, with its rows of encoded observations; views."""
        return ((m, o[:, : m.size]) for m, o in zip(self.members, observation, strict=True))

    def _by_member(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(len(self.members), self._lanes, *values.shape[1:])

    def _tensor(self, values: Float32) -> Tensor:
        return torch.from_numpy(values).to(self._device)

    def write_to_agents(self) -> None:
        """Write weights and moments into the members' agents."""
        self._stack.write_to_agents()
        for member in self.members:
            member.agent._n_updates = self._n_updates

    def evaluate(self, evaluation: Callable[[Job, BaseAlgorithm], None] = Job.evaluate) -> None:
        """Let each member that hasn't failed play its policy."""
        self.write_to_agents()
        for member in self.members:
            if not member.failed:
                member.evaluate(evaluation)

    def evaluate_amid(self) -> None:
        """Evaluate between steps of training, whose episodes go on or, of one robot, begin anew."""
        self.evaluate()
        if self.members[0].job.run.one_robot:
            self._observation = self._encode(self._robots.restart())

    def evaluate_if_due(self, keep_checkpoint: bool) -> None:
        """Evaluate, if it is time; see `RunSettings.is_evaluation_due`."""
        if self.members[0].job.is_evaluation_due(self.step, self._episode_ended, keep_checkpoint):
            self.evaluate_amid()

    def close(self) -> None:
        """Free what the environments hold."""
        self._robots.lanes.close()
        for member in self.members:
            member.job.close()

    @property
    def failed(self) -> list[Member]:
        """Those that can't go on."""
        return [member for member in self.members if member.failed]

    @property
    def goes_on(self) -> bool:
        """Whether there are steps to go, and members to take them."""
        wanted = self._settings.agent_steps
        return self.agent_step < wanted and len(self.failed) < len(self.members)

    def member_of(self, lane: int) -> Member:
        """Whose lane of all it is."""
        return self.members[lane // self._lanes]

    def survivors(self) -> tuple["Cohort", list[Snapshot]]:
        """A cohort of those that haven't failed, and what restores it as far as they are.

        It has the memory of their replay buffers, which aren't in the snapshots.
        """
        self.write_to_agents()
        going = [number for number, member in enumerate(self.members) if not member.failed]
        members = [self.members[number] for number in going]
        snapshots = [self.take(member) for member in members]
        for snapshot in snapshots:
            del snapshot.tensors[_REPLAY]
        self.close()
        self._replay.keep(going)
        return Cohort(members, self._replay), snapshots

    def take(self, member: Member) -> Snapshot:
        """Everything that decides how a member's training continues, whoever is beside it.

        `write_to_agents` comes first.
        """
        tensors, counters = member.take()
        number = self.members.index(member)
        own = slice(number * self._lanes, (number + 1) * self._lanes)
        tensors |= {f"{LANES}{name}": each[own] for name, each in self._robots.state.items()}
        tensors |= {"observation": self._observation[number]}
        tensors |= {_REPLAY: self._replay.rows_of(number)}
        return Snapshot(tensors, {**counters, "added": self._replay.added})

    def restore(self, snapshots: Sequence[Snapshot]) -> None:
        """Continue from where snapshots of all members were taken, at the same step.

        They lose their replay buffers: memory is enough for one replay buffer of each member.
        """
        for member, snapshot in zip(self.members, snapshots, strict=True):
            with member.job.checkpoint.resuming():
                member.restore(snapshot)
        self._stack.read_from_agents()
        self.agent_step, self._n_updates = self._shared.num_timesteps, self._shared._n_updates
        tensors = [each.tensors for each in snapshots]
        self._observation = np.stack([each["observation"] for each in tensors])
        if _REPLAY in tensors[0]:
            self._replay.restore((e.pop(_REPLAY) for e in tensors), snapshots[0].counters["added"])
        lanes = [without(LANES, each) for each in tensors]
        self._robots.restore({n: joined([each[n] for each in lanes]) for n in lanes[0]})


def padded_size(job: Job) -> int:
    """Numbers that each observation of a run has in a cohort, zeros among them."""
    return max(job.run.task.size, job.encoder.latent_size)


def joined(states: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """The lanes of several members; where they took different numbers of steps, the longest's."""
    longest = np.max([each.shape for each in states], axis=0)
    longest[0] = 0
    padding = [np.maximum(longest - each.shape, 0) for each in states]
    wide = [np.pad(e, [(0, p) for p in own]) for e, own in zip(states, padding, strict=True)]
    return np.concatenate(wide)
