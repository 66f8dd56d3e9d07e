"""What is learned from stored steps through a code, and what acting by it returns."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from jbrep.dataset import Dataset
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.envs.recording import Actor, episode_returns, held, record
from jbrep.envs.task import Array, Task
from jbrep.evaluate.evaluation import Learned, Score, score
from jbrep.rl.files import EVALUATION_SEED
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.worth import fitted, planning
from jbrep.worth.fitted import Choose, Coded, Fourier, Trees, Values
from jbrep.worth.steps import Transitions, candidates, joined, most, recorded, stored

_Learn = Callable[[Coded, Task, float], Choose]  # with the discount of a held step

EPISODES = 20  # that are played, and again for steps of its own
_GAMMA = 0.99  # of a control step
_DECISIONS = 100  # in an episode of full length
_EXPLORED = 0.2  # share of actions at random in steps of its own
_CHOSEN = 500  # codes for which actions are chosen at once
_LEFT = 0.01  # share of a discounted sum that backups may leave out
_OWN_SEED = EVALUATION_SEED // 2


def _fitted(kind: Callable[[Coded], Values], steps: Coded, task: Task, gamma: float) -> Choose:
    return fitted.q_iteration(kind(steps), steps, gamma, candidates(task))


def _planned(model: Callable[[Coded], Any], steps: Coded, task: Task, gamma: float) -> Choose:
    return planning.planned(model(steps), gamma, task.action_size)


_WAYS: Mapping[str, _Learn] = {
    "trees": partial(_fitted, Trees),
    "fourier": partial(_fitted, Fourier),
    "linear model": partial(_planned, planning.linear_model),
    "network model": partial(_planned, planning.network_model),
}


@dataclass(frozen=True)
class Ground:
    """Stored steps, and where what is learned from them is played.

    Args:
        task: what is done.
        hold: control steps in which an action is held.
        seen: steps to learn from.
        unseen: of held-out episodes.
        lanes: to play in, one for each episode; None where the environment can't be made.
    """

    task: Task
    hold: int
    seen: Transitions
    unseen: Transitions
    lanes: Lanes | None

    @classmethod
    def of(cls, data: Dataset, lanes: Lanes | None) -> "Ground":
        """The training and the held-out part of a data set.

        Raises:
            InputError: as `stored`.
        """
        longest = int(data.episodes["length"].max())
        hold = max(1, longest // _DECISIONS)
        room = most(data.task) - EPISODES * _DECISIONS
        seen, unseen = (
            stored(data, np.random.default_rng(0).permutation(numbers), hold, room)
            for numbers in data.split_episodes()
        )
        return cls(data.task, hold, seen, unseen, lanes)

    @property
    def rewards(self) -> tuple[float, float]:
        """Mean and standard deviation of what the steps to learn from earn, each a step."""
        return float(self.seen.reward.mean()), float(self.seen.reward.std())

    @property
    def gamma(self) -> float:
        """The discount of a held step."""
        return float(_GAMMA**self.hold)


def learned(encoder: BaseEncoder, ground: Ground, way: str) -> Learned:
    """What a code is worth to a way of learning from stored steps.

    With an environment that is the true return of what was learned, and then again of what was
    learned once more, with steps of its own beside the stored ones. Without, it is estimated from
    the held-out episodes.
    """
    began, task = time.process_time(), ground.task
    learn = _WAYS[way]
    choose = learn(_coded(encoder, ground.seen), task, ground.gamma)
    if ground.lanes is None:
        first, again = _estimated(encoder, ground, choose), None
    else:
        lanes, act = ground.lanes, _acting(encoder, task, choose)
        first = _played(lanes, act, ground.hold)
        own = _own_steps(lanes, act, ground.hold)
        more = _coded(encoder, joined([ground.seen, *own]))
        again_act = _acting(encoder, task, learn(more, task, ground.gamma))
        again = _played(lanes, again_act, ground.hold)
    return Learned(score=first, again=again, seconds=time.process_time() - began)


def bounds_of(task: Task) -> Bounds:
    """Of the returns of its episodes."""
    return Bounds.of(task.return_floor, task.return_ceiling)


def _coded(encoder: BaseEncoder, steps: Transitions) -> Coded:
    before, after = (
        np.asarray(encoder.encode(each), np.float32)
        for each in (steps.observation, steps.next_observation)
    )
    return Coded(before, after, steps)


def _acting(encoder: BaseEncoder, task: Task, choose: Choose) -> Actor:
    """A policy on observations, of one on codes."""

    def act(observation: Array) -> Array:
        code = np.asarray(encoder.encode(observation.astype(np.float32)), np.float32)
        return task.unscale_action(choose(code))

    return act


def _played(lanes: Lanes, act: Actor, hold: int) -> Score:
    """The mean return of 20 episodes, with its interval over them."""
    returns = episode_returns(lanes, held(act, hold), EVALUATION_SEED)
    return score(mean_within(returns, bounds_of(lanes.task), LEVEL))


def _own_steps(lanes: Lanes, act: Actor, hold: int) -> list[Transitions]:
    """Steps of a policy that explores, of each episode."""
    task, random = lanes.task, np.random.default_rng(0)
    drawn = candidates(task)

    def explore(observation: Array) -> Array:
        chosen, count = act(observation), len(observation)
        at_random = task.unscale_action(drawn[random.integers(0, len(drawn), count)])
        return np.where(random.random((count, 1)) < _EXPLORED, at_random, chosen)

    lanes.reset(range(EPISODES), range(_OWN_SEED, _OWN_SEED + EPISODES))
    return recorded(record(lanes, held(explore, hold), lambda steps: None), task, hold)


def _estimated(encoder: BaseEncoder, ground: Ground, choose: Choose) -> Score:
    """The return of an episode by fitted Q-evaluation on held-out steps (Le et al. 2019).

    That is the discounted mean reward from the held-out starts on, times the steps of an episode.
    Its interval is over the starts alone: the error of the fit is not in it.
    """
    steps, task = _coded(encoder, ground.unseen), ground.task
    values = Trees(steps)
    parts = np.array_split(steps.next_code, -(-len(steps.next_code) // _CHOSEN))
    ahead = values.prepare(steps.next_code, np.concatenate([choose(part) for part in parts]))
    until_still = math.ceil(math.log(_LEFT) / math.log(ground.gamma))
    backups = max(fitted.BACKUPS, until_still)
    fitted.backup(values, steps.held, ground.gamma, lambda: values.at(ahead), backups)
    starts = steps.code[steps.held.first]
    value = values.at(values.prepare(starts, choose(starts)))
    returns = value * (1 - ground.gamma) * task.max_episode_steps
    return score(mean_within(returns, bounds_of(task), LEVEL))
