"""The collector: a policy on many Jitterbugs, streamed to the shards of a data set."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from operator import index
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Policy, make_policy, policy_settings
from jbrep.dataset.manifest import (
    MANIFEST,
    Manifest,
    Settings,
    check_files,
    commit,
    hdf5_files,
    new_manifest,
    read_manifest,
    write_manifest,
)
from jbrep.dataset.schema import EPISODES, Columns, episode_returns, episode_seed
from jbrep.errors import InputError, differences
from jbrep.files.lock import exclusive
from jbrep.files.storage import check_space, make_folder
from jbrep.jitterbug.simulation import Simulation, check_counts
from jbrep.jitterbug.tasks import EPISODE_STEPS, get_task
from jbrep.progress import Progress

LANES = 100

Array = NDArray[Any]
Tick = Callable[[int], object]  # told how many control steps were made


class Written(NamedTuple):
    """What a call did."""

    manifest: Manifest
    rows: int  # written by it
    seconds: float


def collect(
    settings: Settings, folder: Path, lanes: int = LANES, num_threads: int | None = None
) -> Written:
    """Collect what is missing of a data set; neither lanes nor threads change a byte of it.

    Args:
        settings: what to collect.
        folder: new, or one where the same was begun.
        lanes: how many robots to step at once.
        num_threads: threads to step them on; None takes one for each core.

    Raises:
        InputError: settings that can't be, other settings in the folder, a shard that is gone or
            cut short, or no space.
    """
    policy = make_policy(settings.policy)
    settings = replace(
        settings,
        policy=policy_settings(policy),
        steps=index(settings.steps),  # it may be NumPy's, which JSON wouldn't take
        seed=index(settings.seed),
        shard_episodes=index(settings.shard_episodes),
    )
    check_counts(lanes, num_threads)

    def make(shard: int, tick: Tick) -> Columns:
        return simulate_shard(settings, policy, shard, tick, lanes, num_threads)

    return write_shards(settings, folder, make)


def write_shards(settings: Settings, folder: Path, make: Callable[[int, Tick], Columns]) -> Written:
    """Commit the shards that are missing, each as `make` gives it.

    Raises:
        InputError: as `collect` does.
    """
    settings.check()
    began = time.monotonic()
    make_folder(folder)
    with exclusive(folder):
        manifest = _begin(settings, folder)
        rows = sum(entry.rows for entry in manifest.shards)
        with Progress(
            total=settings.episodes * EPISODE_STEPS,
            initial=rows,
            unit="step",
            unit_scale=True,
            desc=folder.name,
        ) as progress:
            for shard in range(len(manifest.shards), settings.num_shards):
                manifest = commit(folder, manifest, make(shard, progress.update))
                size = sum(entry.bytes for entry in manifest.shards)
                progress.set_postfix_str(f"{size / 1e6:,.0f} MB on disk")
    made = sum(entry.rows for entry in manifest.shards) - rows
    return Written(manifest, made, time.monotonic() - began)


def _begin(settings: Settings, folder: Path) -> Manifest:
    """The manifest to go on from."""
    files = hdf5_files(folder)
    if (folder / MANIFEST).exists() or files:
        manifest = read_manifest(folder)
        _check_same(manifest, new_manifest(settings), folder)
        check_files(folder, manifest, files)
    else:
        manifest = new_manifest(settings)
        check_space(folder, settings.episodes * EPISODE_STEPS * settings.row_bytes())
        write_manifest(folder, manifest)
    return manifest


def _check_same(there: Manifest, wanted: Manifest, folder: Path) -> None:
    """Going on must give what an uninterrupted run gives."""
    differing = differences(asdict(there.settings), asdict(wanted.settings))
    if differing:
        raise InputError(
            f"{folder} holds a data set of other settings: {differing}; "
            "choose another folder, or the same settings to go on"
        )
    differing = differences(there.versions, wanted.versions)
    if differing and not there.complete:
        raise InputError(
            f"{folder} was begun with other versions: {differing}; "
            "install those to go on, or choose another folder"
        )


def simulate_shard(
    settings: Settings,
    policy: Policy,
    shard: int,
    tick: Tick,
    lanes: int = LANES,
    num_threads: int | None = None,
) -> Columns:
    """The columns of a shard, which are a function of its number and the settings alone."""
    episodes = np.array(settings.shard_range(shard))
    blocks = [
        _simulate(settings, policy, episodes[start : start + lanes], tick, num_threads)
        for start in range(0, len(episodes), lanes)
    ]
    return {name: np.concatenate([block[name] for block in blocks]) for name in settings.specs()}


def _simulate(
    settings: Settings, policy: Policy, episodes: Array, tick: Tick, num_threads: int | None
) -> dict[str, Array]:
    """Columns of n whole episodes, one in each lane."""
    task, n = get_task(settings.task), len(episodes)
    seeds = [episode_seed(settings.seed, int(episode)) for episode in episodes]
    randoms = [np.random.default_rng(seed) for seed in seeds]
    simulation = Simulation(task, n, num_threads)
    simulation.reset(range(n), randoms)
    start = {
        "initial_qpos": simulation.readings.qpos.copy(),
        "initial_qvel": simulation.readings.qvel.copy(),
        "target_position": simulation.readings.target_position.copy(),
        "target_quaternion": simulation.target_quaternion.copy(),
    }
    act = policy.begin(task, randoms)
    tape = _Tape(simulation, settings.store_state)
    for step in range(EPISODE_STEPS):
        tape.action[step] = act(tape.record_state(step))
        diverged = simulation.step(tape.action[step])
        tape.record_outcome(step, diverged)
        tick(n)
    tape.record_state(EPISODE_STEPS)
    rows = tape.rows(episodes)
    ends = start | {"seed": np.array(seeds)} | tape.ends(episodes, rows["reward"])
    return rows | {EPISODES + name: column for name, column in ends.items()}


class _Tape:
    """What n lanes go through in T steps, time first: states (T + 1, n, ...), steps (T, n, ...)."""

    def __init__(self, simulation: Simulation, store_state: bool):
        task, n = simulation.task, simulation.num_lanes
        self._simulation = simulation
        sources: dict[str, Array] = {
            "qpos": simulation.readings.qpos,
            "qvel": simulation.readings.qvel,
        }
        self._sources = sources if store_state else {}
        self._states: dict[str, Array] = {
            name: np.empty((EPISODE_STEPS + 1, *source.shape))
            for name, source in self._sources.items()
        }
        self._states["observation"] = np.empty((EPISODE_STEPS + 1, n, task.size), np.float32)
        self.action = np.empty((EPISODE_STEPS, n, 1), np.float32)
        self._reward = np.empty((EPISODE_STEPS, n), np.float32)
        self._length = np.full(n, EPISODE_STEPS, np.int32)

    def record_state(self, step: int) -> Array:
        """Write down the state that the lanes are in, and give what is observed."""
        for name, source in self._sources.items():
            self._states[name][step] = source
        observation = self._simulation.observe()
        self._states["observation"][step] = observation
        return observation

    def record_outcome(self, step: int, diverged: NDArray[np.bool_]) -> None:
        """Write down what the action led to; an episode ends before the step that diverged."""
        self._reward[step] = self._simulation.reward()
        self._length[diverged] = np.minimum(self._length[diverged], step)

    def rows(self, episodes: Array) -> dict[str, Array]:
        """Columns by step, an episode after the other."""
        step = np.arange(EPISODE_STEPS, dtype=np.int32)
        kept = step < self._length[:, None]
        steps = self._states | {"action": self.action, "reward": self._reward}
        rows: dict[str, Array] = {
            "episode": np.repeat(episodes.astype(np.int32), self._length),
            "step": np.broadcast_to(step, kept.shape)[kept],
        }
        return rows | {name: a[:EPISODE_STEPS].swapaxes(0, 1)[kept] for name, a in steps.items()}

    def ends(self, episodes: Array, reward: Array) -> dict[str, Array]:
        """Columns by episode; the reward is that of the rows."""
        lanes = np.arange(len(episodes))
        ends: dict[str, Array] = {
            "episode": episodes.astype(np.int32),
            "length": self._length,
            "return": episode_returns(reward, self._length),
            "diverged": (self._length < EPISODE_STEPS).astype(np.uint8),
        }
        return ends | {f"final_{name}": a[self._length, lanes] for name, a in self._states.items()}
