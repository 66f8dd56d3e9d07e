"""Runs of one task and algorithm that learn side by side, each as it would alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jbrep.envs.endless import Endless
from jbrep.rl.agent import training_seed
from jbrep.rl.checkpoint import LANES, Snapshot, without
from jbrep.rl.cohort.learner import Learner, give_back, stacked
from jbrep.rl.cohort.member import Array, Float32, Member
from jbrep.rl.cohort.replay import Replay, capacity_of
from jbrep.rl.cohort.steps import Batch, set_rate
from jbrep.rl.history import ACTIONS_NOT_FINITE
from jbrep.rl.job import Job


class Cohort:
    """The stack of n members: what they see, remember and learn.

    Args:
        members: which can learn together, see `jbrep.rl.cohort.settings.shared_by`.

    Attributes:
        members: n.
        step: of training, over the lanes of a member.
    """

    def __init__(self, members: Sequence[Member]):
        run, agent = members[0].job.run, members[0].agent
        self.members, self.step = members, 0
        self._shared: Any = agent  # its settings are those of all
        self._lanes, self._steps = run.used.num_envs, run.steps
        self._low, self._high = agent.action_space.low, agent.action_space.high
        self._size = filled_up(members[0].job)
        numbers = self._size, run.task.action_size
        self._replay = Replay(len(members), self._lanes, capacity_of(run), *numbers)
        self._endless = Endless(run.task, len(members) * self._lanes, run.physics_threads)
        self._device = torch.device(run.device)
        self._learner = self._stacked()
        self._updates = 0
        seeds = [training_seed(m.job.run.seed) + i for m in members for i in range(self._lanes)]
        self._look(self._see(self._endless.reset(seeds)))

    @property
    def is_evaluation_due(self) -> bool:
        """Whether policies are to be evaluated at this step, which isn't the last."""
        return self.members[0].job.run.is_evaluation_due(self.step, self._lanes)

    @property
    def rollout(self) -> int:
        """How often the environments are stepped between gradient steps."""
        return int(self._shared.train_freq.frequency)

    def act(self) -> None:
        """Step every lane, and remember what came of it.

        Raises:
            EnvironmentFailedError: an environment fails; `member_of` its lane says whose it is.
        """
        chosen = self._explore()
        action = np.clip(self._unscaled(chosen), self._low, self._high)
        moved = self._endless.step(action.reshape(-1, action.shape[2]).astype(float))
        self.step += self._lanes
        ended, terminated = self._by_member(moved.ended), self._by_member(moved.terminated)
        reward = self._by_member(moved.reward).astype(np.float32)
        after = self._see(moved.observation)
        final = after
        if ended.any():
            final = np.where(ended[..., None], self._see(moved.final), after)
        closed = (ended & terminated)[..., None]
        self._replay.add(self._seen, chosen, final, reward[..., None], closed)
        self._look(after)
        diverged = self._by_member(moved.diverged)
        for member, *own in zip(self.members, reward, ended, diverged, strict=True):
            if member.record(*own):
                member.log()

    def learn(self) -> None:
        """Take the gradient steps that follow a rollout."""
        if self.step <= self._shared.learning_starts:
            return
        steps = self._shared.gradient_steps
        if steps < 0:  # as many as were collected
            steps = self.rollout * self._lanes
        rate = self._shared.lr_schedule(1 - self.step / self._steps)
        told = [self._update(rate, index) for index in range(steps)]
        names = dict.fromkeys(name for losses in told for name in losses)
        means = [torch.stack([x[name] for x in told if name in x]).mean(0) for name in names]
        rows = torch.stack([*means, self._learner.size_of_actors()], 1).tolist()
        for member, (*own, weights) in zip(self.members, rows, strict=True):
            member.learnt(dict(zip(names, own, strict=True)), weights)

    def take(self, member: Member) -> Snapshot:
        """Everything that decides how a member's training continues; `give_back` comes first.

        It is that of the member alone, whoever is beside it.
        """
        tensors, counters = member.take()
        number = self.members.index(member)
        own = slice(number * self._lanes, (number + 1) * self._lanes)
        tensors |= {f"{LANES}{name}": each[own] for name, each in self._endless.state.items()}
        tensors |= {"seen": self._seen[number], "replay": self._replay.of(number)}
        return Snapshot(tensors, {**counters, "added": self._replay.added})

    def restore(self, snapshots: Sequence[Snapshot]) -> None:
        """Continue from where snapshots of all members were taken, at the same step."""
        for member, snapshot in zip(self.members, snapshots, strict=True):
            member.restore(snapshot)
        agent = self.members[0].agent
        self._learner = self._stacked()
        self.step, self._updates = agent.num_timesteps, agent._n_updates
        tensors = [each.tensors for each in snapshots]
        self._seen = np.stack([each["seen"] for each in tensors])
        self._replay.refill([each["replay"] for each in tensors], snapshots[0].counters["added"])
        lanes = [without(LANES, each) for each in tensors]
        self._endless.restore({n: joined([each[n] for each in lanes]) for n in lanes[0]})

    def member_of(self, lane: int) -> Member:
        """Whose lane of all it is."""
        return self.members[lane // self._lanes]

    def evaluate(self) -> None:
        """Let each member play its policy that hasn't failed."""
        self.give_back()
        for member in self.members:
            if not member.failure:
                member.evaluate()

    @property
    def failed(self) -> list[Member]:
        """Those that can't go on."""
        return [member for member in self.members if member.failure]

    @property
    def goes_on(self) -> bool:
        """Whether there are steps to go, and members to take them."""
        return self.step < self._steps and len(self.failed) < len(self.members)

    def survivors(self) -> "Cohort":
        """Those that haven't failed, as far as they are."""
        if not self.failed:
            return self
        self.give_back()
        going = [member for member in self.members if not member.failure]
        snapshots = [self.take(member) for member in going]
        others = Cohort(going)
        others.restore(snapshots)
        return others

    def give_back(self) -> None:
        """Write weights and moments into the members' agents."""
        give_back(self._learner, [member.agent for member in self.members], self._size)
        for member in self.members:
            member.agent._n_updates = self._updates

    def _stacked(self) -> Learner:
        run = self.members[0].job.run
        agents = [member.agent for member in self.members]
        return stacked(agents, self._size, run.precision, self._device)

    def _update(self, rate: float, index: int) -> dict[str, Tensor]:
        """Take a gradient step, at a learning rate."""
        self._updates += 1
        size, learner = self._shared.batch_size, self._learner
        draws = [member.draws for member in self.members]
        places = [each.places(self._replay.filled, size) for each in draws]
        steps, lanes = (np.stack(each) for each in zip(*places, strict=True))
        sampled = self._replay.sample(steps, lanes, self._shown)
        batch = Batch(*(each.to(self._device) for each in sampled))
        normals = self._normals(learner.draws_to_learn, size)
        set_rate(learner.optimizers, rate)
        return learner.update(batch, normals, learner.is_due(self._updates, index))

    def _normals(self, count: int, rows: int) -> list[Tensor]:
        """So many draws of standard normal numbers, (n, rows, k) each."""
        size = len(self._low)
        draws = [[m.draws.normal(rows, size) for _ in range(count)] for m in self.members]
        return [torch.stack(each).to(self._device) for each in zip(*draws, strict=True)]

    def _explore(self) -> Float32:
        """Actions scaled to [-1, 1], (n, lanes, k), rounded as stable-baselines3 rounds them."""
        draws = [member.draws for member in self.members]
        if self.step < self._shared.learning_starts:
            actions = np.stack([each.random_actions() for each in draws])
        else:
            normals = self._normals(self._learner.draws_to_explore, self._lanes)
            with torch.no_grad():
                shown = torch.from_numpy(self._shown(self._seen)).to(self._device)
                chosen = self._learner.explore(shown, normals)
            actions = self._unscaled(chosen.numpy(force=True))
            self._stop_at_non_finite(actions)
        scaled = 2 * ((actions - self._low) / (self._high - self._low)) - 1
        noise = np.stack([each.noise() for each in draws])
        return np.clip(scaled + noise, -1, 1)

    def _stop_at_non_finite(self, actions: Float32) -> None:
        """Let members fail whose actions aren't finite; they do nothing in this step."""
        wrong = ~np.isfinite(actions)
        for number in np.flatnonzero(wrong.any((1, 2))).tolist():
            self.members[number].fail(ACTIONS_NOT_FINITE)
        actions[wrong] = 0

    def _unscaled(self, scaled: Float32) -> Float32:
        return self._low + 0.5 * (scaled + 1) * (self._high - self._low)

    def _look(self, seen: Float32) -> None:
        """Take what is seen now, (n, lanes, size), into the statistics that normalise it."""
        self._seen = seen
        for rows, member in zip(seen, self.members, strict=True):
            if member.normalizer:
                member.normalizer.obs_rms.update(rows[:, : member.size])

    def _see(self, observation: Array) -> Float32:
        """What each member sees in each lane, filled up with zeros, (n, lanes, size)."""
        seen = np.zeros((len(self.members), self._lanes, self._size), np.float32)
        for rows, member, own in zip(seen, self.members, self._by_member(observation), strict=True):
            rows[:, : member.size] = member.see(own)
        return seen

    def _shown(self, seen: Float32) -> Float32:
        """What members see, (n, rows, size), normalised where that is asked for."""
        if not self.members[0].normalizer:
            return seen
        shown = seen.copy()
        for rows, member in zip(shown, self.members, strict=True):
            if member.normalizer:
                rows[:, : member.size] = member.normalizer.normalize_obs(rows[:, : member.size])
        return shown

    def _by_member(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(len(self.members), self._lanes, *values.shape[1:])


def filled_up(job: Job) -> int:
    """Numbers that each observation of a run has in a cohort, zeros among them."""
    return max(job.run.task.size, job.encoder.latent_size)


def joined(states: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """The lanes of several members; where they took different numbers of steps, the longest's."""
    longest = np.max([each.shape for each in states], axis=0)
    longest[0] = 0
    padding = [np.maximum(longest - each.shape, 0) for each in states]
    wide = [np.pad(e, [(0, p) for p in own]) for e, own in zip(states, padding, strict=True)]
    return np.concatenate(wide)
