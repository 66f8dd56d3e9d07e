"""What is checked: steps of whole episodes, played by simple policies or read from a data set."""

import time
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.collecting.policies import Constant, OrnsteinUhlenbeck, Policy, Still, Uniform
from jbrep.dataset import Dataset
from jbrep.envs.environments import envs_at_once
from jbrep.envs.recording import held, record
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.progress import Progress

RANDOM, HELD, CONSTANT = "uniform random", "uniform random, held for", "constant:drive="
REPEATS = {RANDOM: 1, **{f"{HELD} {repeat}": repeat for repeat in (2, 4, 8, 16)}}
# coloured noise that returns by 5 % in a step, where a step counts as 1 s, and deviates by 0.7
_NOISE = OrnsteinUhlenbeck(theta=0.05, sigma=0.7 * 0.1**0.5)
POLICIES: dict[str, tuple[Policy, int]] = {  # with the steps for which each action is held
    **{name: (Uniform(), repeat) for name, repeat in REPEATS.items()},
    "coloured noise": (_NOISE, 1),
    "standing still": (Still(), 1),
    **{f"{CONSTANT}{drive:g}": (Constant(drive=drive), 1) for drive in (-1.0, -0.5, 0.5, 1.0)},
}
_FEWEST, _MOST = 4, 200  # episodes of a policy
_AT_ONCE, _SHORTEST = 8, 20  # environments; steps to which an episode may be cut
_Columns = tuple[NDArray[Any], ...]


class Transitions(NamedTuple):
    """n steps of whole episodes, one episode after the other."""

    task: Task
    before: Array  # observation before each step, (n, d)
    after: Array  # and after it, (n, d)
    action: Array  # (n, k)
    reward: Array  # (n,), NaN where it isn't known
    episode: NDArray[np.int64]  # number of each step's episode, (n,)
    step: NDArray[np.int64]  # and its own in that, from 0, (n,)
    ended: NDArray[np.bool_]  # whether a state ended the episode there, (n,)
    policy: NDArray[np.str_]  # what acted, (n,); of data RANDOM, as far as is known


class PlayStats(NamedTuple):
    """What came of playing."""

    returns: dict[str, Array]  # of each policy's episodes
    limit: int  # steps to which these were cut
    rate: float  # steps a second


def play(task: Task, steps: int, seed: int) -> tuple[Transitions, PlayStats]:
    """Play each policy for about its share of the steps, at least four episodes, perhaps cut."""
    share = steps // len(POLICIES)
    limit = min(task.max_episode_steps, max(_SHORTEST, -(-share // _FEWEST)))
    cut = task.replace(max_episode_steps=limit)
    at_once = min(_AT_ONCE, max(_FEWEST, share // limit)) if task.reproducible else 1
    episodes, returns, seconds = list[_Columns](), dict[str, Array](), 0.0
    with (
        envs_at_once(cut, at_once, None, 0) as envs,
        Progress(total=steps, unit="step", unit_scale=True, leave=False, delay=1) as bar,
    ):
        for name, (policy, repeat) in POLICIES.items():
            own, first = list[Array](), seed << 10
            while len(own) < _FEWEST or (sum(map(len, own)) < share and len(own) < _MOST):
                seeds = range(first, first := first + envs.num_envs)
                envs.reset(range(envs.num_envs), seeds)
                act, began = policy.begin(task.replace(timestep=1.0), seeds), time.perf_counter()
                made = record(envs, held(act, repeat), bar.update)
                seconds += time.perf_counter() - began
                for index, n in enumerate(made.length.tolist()):
                    rows, action = made.observation[: n + 1, index], made.action[:n, index]
                    own.append(made.reward[:n, index].astype(np.float64))
                    ended = bool(made.terminated[index])
                    episodes.append(_columns(len(episodes), rows, action, own[-1], ended, name))
            returns[name] = np.array([each.sum() for each in own])
    seen = _joined(task, episodes)
    return seen, PlayStats(returns, limit, len(seen.reward) / seconds)


def read(data: Dataset, steps: int, seed: int) -> Transitions:
    """Episodes of a data set, drawn until they have so many steps."""
    lengths = data.episodes["length"]
    order = np.random.default_rng(seed).permutation(len(lengths))
    before = lengths[order].cumsum() - lengths[order]
    chosen = np.sort(order[before < steps]).tolist()
    if (total := int(lengths[chosen].sum())) < _SHORTEST:
        raise InputError(f"{data.folder} has {total} steps: a check needs at least {_SHORTEST}")
    episodes = list[_Columns]()
    for number in chosen:
        episode, n = data.episode(number), min(int(lengths[number]), steps)
        rows = np.concatenate((episode["observation"], episode.record["final_observation"][None]))
        reward = episode["reward"] if "reward" in data.columns else np.full(n, np.nan)
        ended = bool(episode.record["terminated"]) and n == lengths[number]
        given = rows[: n + 1], episode["action"][:n], reward[:n]
        episodes.append(_columns(number, *given, ended, RANDOM))
    return _joined(data.task, episodes)


def _columns(
    number: int, rows: NDArray[Any], action: Array, reward: Array, ended: bool, name: str
) -> _Columns:
    rows, step = rows.astype(np.float64), np.arange(len(action))
    alike = [np.full(len(action), each) for each in (number, name)]
    return (
        rows[:-1],
        rows[1:],
        action,
        reward,
        alike[0],
        step,
        ended & (step == step[-1:]),
        alike[1],
    )


def _joined(task: Task, episodes: Iterable[_Columns]) -> Transitions:
    return Transitions(task, *map(np.concatenate, zip(*episodes, strict=True)))
