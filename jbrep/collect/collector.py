"""The collector: a policy on many Jitterbugs, written to the shards of a data set."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.collect.policies import Policy, make_policy, policy_settings
from jbrep.dataset.manifest import (
    MANIFEST,
    Manifest,
    check_files,
    commit,
    hdf5_files,
    new_manifest,
    read_manifest,
    write_manifest,
)
from jbrep.dataset.schema import (
    EPISODES,
    STATE_COLUMNS,
    Columns,
    episode_returns,
    episode_seed,
)
from jbrep.dataset.settings import Settings
from jbrep.errors import InputError, differences
from jbrep.files.lock import exclusive
from jbrep.files.storage import check_space, make_folder
from jbrep.jitterbug.episodes import Recording, Tick, record
from jbrep.jitterbug.simulation import Simulation, check_counts
from jbrep.jitterbug.tasks import EPISODE_STEPS
from jbrep.progress import Progress

LANES = 100

Array = NDArray[Any]


class Written(NamedTuple):
    """What a call has done."""

    manifest: Manifest
    rows: int  # written by this call
    seconds: float


def collect(
    settings: Settings, folder: Path, lanes: int = LANES, num_threads: int | None = None
) -> Written:
    """Collect a data set, or what is missing of it.

    The number of lanes and threads doesn't change a byte.

    Args:
        settings: what to collect.
        folder: new, or with an unfinished data set of the same settings.
        lanes: robots stepped at once.
        num_threads: threads to step them on; None takes one for each core.

    Raises:
        InputError: invalid settings, a data set of other settings in the folder, a shard that is
            missing or damaged, or too little disk space.
    """
    policy = make_policy(settings.policy)
    settings = replace(settings, policy=policy_settings(policy))
    check_counts(lanes, num_threads)

    def make(shard: int, tick: Tick) -> Columns:
        return simulate_shard(settings, policy, shard, tick, lanes, num_threads)

    return write_shards(settings, folder, make)


def write_shards(settings: Settings, folder: Path, make: Callable[[int, Tick], Columns]) -> Written:
    """Commit the missing shards, each with the columns that `make` returns.

    Raises:
        InputError: as `collect` does.
    """
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
    """The manifest to resume from, new if there is none."""
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
    """Check that resuming gives what an uninterrupted run gives."""
    differing = differences(asdict(there.settings), asdict(wanted.settings))
    if differing:
        raise InputError(
            f"{folder} holds a data set with other settings: {differing}; "
            "choose another folder, or the same settings to resume"
        )
    differing = differences(there.versions, wanted.versions)
    if differing and not there.complete:
        raise InputError(
            f"{folder} was started with other versions: {differing}; "
            "install those to resume, or choose another folder"
        )


def simulate_shard(
    settings: Settings,
    policy: Policy,
    shard: int,
    tick: Tick,
    lanes: int = LANES,
    num_threads: int | None = None,
) -> Columns:
    """The columns of a shard: a function of its number and the settings only."""
    episodes = np.array(settings.shard_range(shard))
    blocks = [
        _simulate(settings, policy, episodes[start : start + lanes], tick, num_threads)
        for start in range(0, len(episodes), lanes)
    ]
    return {name: np.concatenate([block[name] for block in blocks]) for name in settings.specs()}


def _simulate(
    settings: Settings, policy: Policy, episodes: Array, tick: Tick, num_threads: int | None
) -> Columns:
    """The columns of some episodes, one in each lane."""
    task, lanes = settings.definition, range(len(episodes))
    seeds = [episode_seed(settings.seed, int(episode)) for episode in episodes]
    randoms = [np.random.default_rng(seed) for seed in seeds]
    simulation = Simulation(task, len(lanes), num_threads)
    simulation.reset(lanes, randoms)
    act = policy.begin(task, randoms)
    recording = record(
        simulation,
        lambda observation: act(observation).astype(np.float32),  # as it is stored
        EPISODE_STEPS,
        STATE_COLUMNS if settings.store_state else (),
        tick,
    )
    rows = _rows(recording, episodes)
    return rows | {
        EPISODES + name: column
        for name, column in _ends(recording, episodes, seeds, rows["reward"]).items()
    }


def _rows(recording: Recording, episodes: Array) -> dict[str, Array]:
    """Columns with a row for each step, one episode after the other."""
    step = np.arange(EPISODE_STEPS, dtype=np.int32)
    kept = step < recording.length[:, None]
    steps = recording.states | {
        "action": recording.action.astype(np.float32),
        "reward": recording.reward,
    }
    rows: dict[str, Array] = {
        "episode": np.repeat(episodes.astype(np.int32), recording.length),
        "step": np.broadcast_to(step, kept.shape)[kept],
    }
    return rows | {
        name: values[:EPISODE_STEPS].swapaxes(0, 1)[kept] for name, values in steps.items()
    }


def _ends(
    recording: Recording, episodes: Array, seeds: Sequence[int], reward: Array
) -> dict[str, Array]:
    """Columns with a row for each episode; the reward is the column with a row for each step."""
    start, length = recording.start, recording.length
    ends: dict[str, Array] = {
        "episode": episodes.astype(np.int32),
        "seed": np.array(seeds),
        "length": length,
        "return": episode_returns(reward, length),
        "diverged": (length < EPISODE_STEPS).astype(np.uint8),
        "initial_qpos": start["qpos"],
        "initial_qvel": start["qvel"],
        "target_position": start["target_position"],
        "target_quaternion": start["target_quaternion"],
    }
    lanes = np.arange(len(episodes))
    return ends | {
        f"final_{name}": values[length, lanes] for name, values in recording.states.items()
    }
