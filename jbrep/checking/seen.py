"""What is checked: steps of whole episodes, played by simple policies or read from a data set."""

import re
import time
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from jbrep.collecting.policies import Constant, OrnsteinUhlenbeck, Policy, Still, Uniform
from jbrep.dataset import Dataset
from jbrep.envs.lanes import lanes_at_once
from jbrep.envs.physics import Motion, MotionReader, robot_joint
from jbrep.envs.recording import held, record
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.progress import Progress

RANDOM, STILL, COLOURED = "uniform random", "standing still", "coloured noise"
HELD, CONSTANT = f"{RANDOM}, held for", "constant:drive="
REPEATS = 2, 4, 8, 16  # steps for which random actions are held, beside 1
_DRIVES = -1.0, -0.5, 0.5, 1.0  # of constant actions, from the lower bound to the upper
_FEWEST, _MOST = 4, 200  # episodes of a policy
_AT_ONCE = 8  # environments
_SHORTEST = 20  # steps to which an episode may be cut
_REVERSION, _DEVIATION = 0.05, 0.7  # of coloured noise: in a step, and the stationary one
_SAME, _MOST_ROWS = 1e-6, 0.9  # relative difference of a feature and a joint; the share alike
_NUMBERED = re.compile(r"obs_\d+")
_FREE = "x y z qw qx qy qz".split(), "vx vy vz wx wy wz".split()


class Seen(NamedTuple):
    """n steps of whole episodes, one episode after the other."""

    task: Task
    before: Array  # observation before each step, (n, d)
    after: Array  # and after it, (n, d)
    action: Array  # (n, k)
    reward: Array  # (n,), NaN where it isn't known
    episode: NDArray[np.int64]  # number of each step's episode, (n,)
    ended: NDArray[np.bool_]  # whether a state ended the episode there, (n,)
    policy: NDArray[np.str_]  # what acted, (n,); of data RANDOM, as far as is known

    @property
    def step(self) -> NDArray[np.int64]:
        """The number of each step in its episode, from 0, (n,)."""
        first = np.flatnonzero(np.diff(self.episode, prepend=-1))
        return np.arange(len(self.episode)) - np.repeat(first, np.diff([*first, len(self.episode)]))


class Played(NamedTuple):
    """What came of playing."""

    returns: dict[str, Array]  # of each policy's episodes
    limit: int  # steps to which these were cut
    rate: float  # steps a second
    joints: dict[str, str]  # what features that are numbered only are called in MuJoCo's model


def policies(task: Task) -> dict[str, tuple[Policy, int]]:
    """Policies that ignore the state, with the steps for which each action is held."""
    noise = OrnsteinUhlenbeck(  # in steps, so that no time step is needed
        theta=_REVERSION, sigma=_DEVIATION * float(np.sqrt(2 * _REVERSION))
    )
    constant = {f"{CONSTANT}{each:g}": (Constant(drive=each), 1) for each in _DRIVES}
    return {
        RANDOM: (Uniform(), 1),
        **{held_for(repeat): (Uniform(), repeat) for repeat in REPEATS},
        COLOURED: (noise, 1),
        STILL: (Still(), 1),
        **constant,
    }


def held_for(repeat: int) -> str:
    """What random actions are called that are held for so many steps."""
    return RANDOM if repeat == 1 else f"{HELD} {repeat}"


def play(task: Task, steps: int, seed: int) -> tuple[Seen, Played]:
    """Play each policy for about its share of the steps, at least four episodes, perhaps cut."""
    every = policies(task)
    share = steps // len(every)
    limit = min(task.max_episode_steps, max(_SHORTEST, share // _FEWEST))
    cut = task.replace(max_episode_steps=limit)
    at_once = min(_AT_ONCE, max(_FEWEST, share // limit)) if task.reproducible else 1
    parts, returns, joints, seconds = [], dict[str, Array](), dict[str, str](), 0.0
    with (
        lanes_at_once(cut, at_once, None, 0) as lanes,
        Progress(total=steps, unit="step", unit_scale=True, leave=False, delay=1) as bar,
    ):
        for name, (policy, repeat) in every.items():
            own, first = list[Array](), seed << 10
            while len(own) < _FEWEST or (sum(map(len, own)) < share and len(own) < _MOST):
                seeds = range(first, first := first + lanes.num_lanes)
                lanes.reset(range(lanes.num_lanes), seeds)
                act = policy.begin(task.replace(timestep=1.0), seeds)
                read, began = MotionReader() if not parts else None, time.perf_counter()
                made = record(lanes, held(act, repeat), bar.update, *([read] if read else []))
                seconds += time.perf_counter() - began
                if read:
                    joints = _joints(task, made.observation, read.motion(made, 0, int(made.length[0])))
                for lane in range(lanes.num_lanes):
                    count = int(made.length[lane])
                    own.append(made.reward[:count, lane].astype(np.float64))
                    parts.append((made, lane, name))
            returns[name] = np.array([each.sum() for each in own])
    seen = _joined(task, parts)
    return seen, Played(returns, limit, len(seen.reward) / seconds, joints)


def _joined(task: Task, parts: list[tuple[Any, int, str]]) -> Seen:
    columns = list[tuple[Any, ...]]()
    for number, (made, lane, name) in enumerate(parts):
        count = int(made.length[lane])
        rows = made.observation[: count + 1, lane].astype(np.float64)
        ended = np.arange(1, count + 1) == (count if made.terminated[lane] else -1)
        action, reward = made.action[:count, lane], made.reward[:count, lane]
        columns.append(
            (rows[:-1], rows[1:], action, reward, np.full(count, number), ended, [name] * count)
        )
    return Seen(task, *(np.concatenate(each) for each in zip(*columns, strict=True)))


def read(data: Dataset, steps: int, seed: int) -> Seen:
    """Episodes of a data set, drawn until they have so many steps."""
    count = len(data.episodes["length"])
    columns, total = dict[int, tuple[Any, ...]](), 0
    for number in np.random.default_rng(seed).permutation(count).tolist():
        episode = data.episode(number)
        if not len(episode) or total >= steps:
            continue
        rows = np.concatenate((episode["observation"], episode.record["final_observation"][None]))
        n = min(len(episode), steps)
        known = "reward" in data.columns
        reward = episode["reward"][:n] if known else np.full(n, np.nan)
        ended = np.arange(1, n + 1) == (len(episode) if episode.record["terminated"] else -1)
        columns[number] = (
            *(rows[:n].astype(np.float64), rows[1 : n + 1].astype(np.float64)),
            *(episode["action"][:n], reward, np.full(n, number), ended, [RANDOM] * n),
        )
        total += n
    if total < _SHORTEST:
        raise InputError(f"{data.folder} has {total} steps: a check needs at least {_SHORTEST}")
    ordered = (columns[number] for number in sorted(columns))
    return Seen(data.task, *(np.concatenate(each) for each in zip(*ordered, strict=True)))


# names of MuJoCo's joints


def _joints(task: Task, observed: NDArray[np.float32], motion: Motion | None) -> dict[str, str]:
    """The joints that numbered features are, where each equals one number of MuJoCo's state."""
    if motion is None:
        return {}
    states = np.hstack((motion.qpos, motion.qvel))
    names = _state_names(motion.model)
    found = dict[str, str]()
    for feature, column in zip(task.feature_names, observed[: len(states), 0].T, strict=True):
        near = np.abs(states - column[:, None]) <= _SAME * np.abs(column).max()
        alike = np.flatnonzero(near.mean(axis=0) >= _MOST_ROWS)
        if _NUMBERED.fullmatch(feature) and len(alike) == 1 and np.ptp(column):
            found[feature] = names[alike[0]]
    return {each: name for each, name in found.items() if [*found.values()].count(name) == 1}


def _state_names(model: mujoco.MjModel) -> list[str]:
    """Of each number of qpos, then of qvel."""
    places, speeds = list[str](), list[str]()
    for joint in range(model.njnt):
        name = model.joint(joint).name or f"joint{joint}"
        name = "root" if joint == robot_joint(model) else name
        kind = model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            places += [f"{name}_{axis}" for axis in _FREE[0]]
            speeds += [f"{name}_{axis}" for axis in _FREE[1]]
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            places += [f"{name}_{axis}" for axis in _FREE[0][3:]]
            speeds += [f"{name}_{axis}" for axis in _FREE[1][3:]]
        else:
            places.append(name)
            speeds.append(f"{name}_velocity")
    return [*places, *speeds]
