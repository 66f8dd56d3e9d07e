"""The collector: what it writes, and that nothing but the settings decides it."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import small
from command import jbrep
from kills import COMMAND, kill_and_resume
from small import contents, settings, write_again, written

from jbrep.collecting import collect, write_shards
from jbrep.collecting.policies import parse_policy
from jbrep.collecting.replay import replay_problems
from jbrep.dataset import DamageError, Dataset
from jbrep.dataset.manifest import find_problems, open_shard, read_manifest
from jbrep.dataset.schema import episode_seed
from jbrep.envs import describe
from jbrep.envs.names import import_modules
from jbrep.errors import InputError
from jbrep.records.storage import exclusive


def test_rows_are_the_episodes_of_a_random_policy(collected):
    dataset = Dataset(collected)
    assert len(dataset) == 5000
    np.testing.assert_array_equal(dataset["episode"], np.repeat(np.arange(5), 1000))
    np.testing.assert_array_equal(dataset["step"], np.tile(np.arange(1000), 5))
    assert abs(dataset["action"][:].mean()) < 0.05
    assert dataset["action"][:].std() == pytest.approx(1 / np.sqrt(3), rel=0.02)


@pytest.mark.parametrize(
    ("changes", "how", "named"),
    [
        ({}, {"num_envs": 0}, "at least 1"),
        ({}, {"num_threads": 0}, "at least 1"),
        ({"policy": {"kind": "sprint"}}, {}, "sprint"),
    ],
)
def test_mistakes_leave_nothing_behind(changes, how, named, tmp_path):
    with pytest.raises(InputError, match=named):
        collect(settings(**changes), tmp_path / "data", **how)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["heuristic", "ornstein-uhlenbeck"])
def test_other_policies_are_collected_and_replayed(kind, tmp_path):
    collect(small.brief(steps=100, policy={"kind": kind}), tmp_path / "data")
    dataset = Dataset(tmp_path / "data")
    constants = {"heuristic": 0, "ornstein-uhlenbeck": 3}[kind]
    assert len(dataset.manifest.settings.policy) == 1 + constants  # defaults written down, too
    assert not list(find_problems(dataset.folder))
    assert not list(replay_problems(dataset, 1))


def test_what_is_there_already_is_left_alone(copied):
    before = contents(copied)
    assert written(copied, lambda: collect(settings(), copied)) == []
    assert read_manifest(copied).complete
    assert contents(copied) == before


def test_no_two_episodes_share_a_seed():
    """Between all episodes of neighbouring and of far roots, and no seed that people give."""
    roots = (0, 1, 2, 7, 2**20, 2**31 - 3, 2**31 - 2)
    numbers = (0, 1, 2, 99, 100, 4_999, 10**6, 2**31 - 1)
    task = describe("face_direction")
    seeds = {episode_seed(task, root, number) for root in roots for number in numbers}
    assert len(seeds) == len(roots) * len(numbers)
    assert min(seeds) >= 2**32
    assert max(seeds) < 2**63


@pytest.mark.usefixtures("diverging")
def test_an_episode_ends_where_its_physics_goes_non_finite(tmp_path, brief):
    """That step keeps its row, with reward 0; the last finite observation stands for the new one.

    The rows that are missing then are made up for by another episode.
    """
    collect(small.brief(steps=300, shard_episodes=4), tmp_path / "data")
    dataset = Dataset(tmp_path / "data")
    np.testing.assert_array_equal(dataset.episodes["length"], [100, 31, 1, 100, 100])
    np.testing.assert_array_equal(dataset.episodes["truncated"], 1)
    np.testing.assert_array_equal(dataset.episodes["terminated"], 0)
    whole = Dataset(brief)
    length = dataset.episodes["length"][whole["episode"][:]]
    kept = whole["step"][:] < length
    last = np.cumsum(dataset.episodes["length"])[1:3] - 1
    for name in whole.columns:
        expected = whole[name][kept]
        if name == "reward":
            assert (expected[last] > 0).any()
            expected[last] = 0
        np.testing.assert_array_equal(dataset[name], expected)
    final = dataset.episodes["final_observation"]
    np.testing.assert_array_equal(final[1], whole["observation"][130])
    np.testing.assert_array_equal(final[2], whole["observation"][200])
    assert not list(find_problems(dataset.folder))
    assert not list(replay_problems(dataset, 5))


@pytest.mark.slow
def test_kills_lose_at_most_the_open_shard(tmp_path):
    """`python tests/helpers/kills.py 200` does many more."""
    assert kill_and_resume(2, tmp_path, seed=0).kills == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_within_seconds_and_it_says_how_to_go_on(number, tmp_path):
    process = subprocess.Popen(
        [*COMMAND, "--steps", "5M", "--out", tmp_path / "data"], stderr=subprocess.PIPE, text=True
    )
    while not (tmp_path / "data" / "shard-00001.h5").exists():  # so that the first counts
        time.sleep(0.1)
        assert process.poll() is None
    process.send_signal(number)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert told.endswith("stopped; the same command resumes it\n")
    assert not list((tmp_path / "data").glob("*.partial"))
    assert len(Dataset(tmp_path / "data")) > 0


def test_a_second_collector_is_refused_until_the_first_is_dead(collected, tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    script = (
        "import sys, time; from pathlib import Path; from jbrep.records.storage import exclusive\n"
        "with exclusive(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", script, folder], stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        for _ in range(2):  # the first refusal must not spoil the second
            began = time.monotonic()
            with pytest.raises(InputError, match=f"written by process {holder.pid} on .* since"):
                write_again(collected, folder)
            assert time.monotonic() - began < 30  # it doesn't wait
        assert [path.name for path in folder.iterdir()] == [".lock"]
    finally:
        holder.kill()
        holder.communicate()
    write_again(collected, folder)
    assert contents(folder) == contents(collected)
    with exclusive(folder):
        pass


def test_a_collector_goes_on_only_where_its_shards_are_whole(collected, tmp_path):
    folder = tmp_path / "data"

    def stop(growth, tick):
        yield open_shard(collected, read_manifest(collected), 0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shards(settings(), folder, stop)
    assert len(read_manifest(folder).shards) == 1
    write_again(collected, folder)
    (folder / "shard-00003.h5").write_bytes(b"cut")
    with pytest.raises(DamageError, match=r"shard-00003\.h5 is damaged"):
        collect(settings(), folder)


import_modules(["environments"])
OPEN = "uniform:0.4+ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3:0.3+constant:drive=0.5:0.3"


def mixed():
    short = describe("face_direction", episode_steps=60)
    policy = parse_policy(OPEN).settings()
    return settings(task=short, policy=policy, steps=600, shard_episodes=4)


@pytest.fixture(scope="module")
def mixture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mixture") / "data"
    collect(mixed(), folder)
    return folder


def test_episodes_say_which_policy_acted_in_them(mixture):
    dataset = Dataset(mixture)
    drawn = dataset.episodes["policy"]
    assert drawn.dtype == np.int32
    assert set(drawn.tolist()) == {0, 1, 2}
    assert len(drawn) == 10
    for number, part in enumerate(drawn):
        actions = dataset.episode(number)["action"]
        kind = 2 if (actions == 0.5).all() else int((actions[0] == 0).all())
        assert kind == part
    assert jbrep("data", "verify", mixture, "--replay", 2).exit_code == 0


def test_neither_environments_nor_threads_change_a_byte(mixture, tmp_path):
    """Shards of four episodes and one of two."""
    for envs, threads in ((1, 1), (3, 2)):
        collect(mixed(), tmp_path / f"{envs}", num_envs=envs, num_threads=threads)
        assert contents(tmp_path / f"{envs}") == contents(mixture)


def test_in_processes_and_extended(tmp_path):
    """Of episodes of any length."""
    policy = parse_policy("uniform:1+constant:drive=-1:1").settings()
    how = {"task": describe("Sledges/Sledge-v0"), "policy": policy, "store_state": False}
    for steps, workers in ((60, 1), (61, 2), (150, 1)):
        some = settings(**how, steps=steps, shard_episodes=5)
        collect(some, tmp_path / "data", num_threads=workers)
    collect(some, tmp_path / "at once", num_threads=1)
    assert contents(tmp_path / "data") == contents(tmp_path / "at once")
    assert not list(find_problems(tmp_path / "data"))
