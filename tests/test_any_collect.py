"""Data sets of any environment: in processes, killed and resumed, verified, read."""

import os
import signal
import sys

import gymnasium
import numpy as np
import pytest
from command import jbrep, start, wait_for, wait_for_the_end_of, workers_of
from small import contents, settings

from jbrep.collecting import backends, collect
from jbrep.collecting.policies import Uniform
from jbrep.collecting.replay import replay_problems
from jbrep.collecting.shards import Growth, Simulator
from jbrep.dataset import Dataset
from jbrep.dataset.formats import export
from jbrep.dataset.manifest import find_problems, new_manifest, read_manifest
from jbrep.dataset.schema import episode_seed
from jbrep.envs import describe
from jbrep.envs.names import import_modules
from jbrep.errors import InputError

import_modules(["environments"])
ID = "Sledges/Sledge-v0"
SLEDGE = describe(ID)


def some(task=SLEDGE, **changes):
    """Settings of some 20 episodes."""
    usual = {"task": task, "steps": 300, "shard_episodes": 5, "store_state": False}
    return settings(**(usual | changes))


LONG = some(steps=8_000, shard_episodes=50)


@pytest.fixture(scope="module")
def sledges(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sledges") / "data"
    collect(some(), folder, num_threads=1)
    return folder


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Collected in turn and in peace."""
    folder = tmp_path_factory.mktemp("long") / "data"
    collect(LONG, folder, num_threads=1)
    return folder


def test_it_is_the_fewest_whole_episodes_with_enough_rows(sledges):
    dataset = Dataset(sledges)
    episodes, count = dataset.episodes, len(dataset.episodes["length"])
    assert 300 <= len(dataset) == episodes["length"].sum() < 300 + episodes["length"][-1]
    assert [entry.episodes for entry in dataset.manifest.shards[:-1]] == [5] * ((count - 1) // 5)
    assert len(set(episodes["length"].tolist())) > 3
    assert (episodes["length"][episodes["terminated"] == 0] == 40).all()
    np.testing.assert_array_equal(episodes["episode"], np.arange(count))
    np.testing.assert_array_equal(episodes["seed"], 4 * 2**32 + np.arange(count))
    owner = np.repeat(np.arange(count), episodes["length"])
    np.testing.assert_array_equal(dataset["episode"], owner)
    assert (episodes["return"] < 0).all()
    assert dataset["action"].shape == (len(dataset), 3)
    assert dataset["action"][:][:, 1].max() > 9
    assert not list(find_problems(sledges))
    assert not list(replay_problems(dataset, count))
    told = jbrep("data", "info", sledges).output
    assert f"{episodes['terminated'].sum()} terminated by a state" in told
    assert f"{ID}, 2 features, 3 actions" in told


def test_an_episode_is_the_one_that_gymnasium_s_environment_has(sledges):
    dataset, environment = Dataset(sledges), gymnasium.make(ID)
    for number in (0, 7):
        episode = dataset.episode(number)
        observation, _ = environment.reset(seed=int(episode.record["seed"]))
        for row in range(len(episode)):
            np.testing.assert_array_equal(episode["observation"][row], np.float32(observation))
            observation, reward, terminated, truncated, _ = environment.step(episode["action"][row])
            assert episode["reward"][row] == np.float32(reward)
        ends = episode.record
        np.testing.assert_array_equal(ends["final_observation"], np.float32(observation))
        assert (terminated, truncated) == (ends["terminated"], ends["truncated"])


def test_shards_of_episodes_that_may_end_early_are_started_together(tmp_path):
    """Though 900 episodes could have more rows than are needed, had they their full length."""
    task = SLEDGE.replace(max_episode_steps=1000)
    made = new_manifest(some(task, steps=200_000, shard_episodes=900))
    assert Growth(tmp_path, made).wants(900)
    brief = made.replace(settings=some(task, steps=900, shard_episodes=1))
    assert not Growth(tmp_path, brief).wants(1)


@pytest.mark.slow
def test_a_shard_that_kills_every_worker_is_named(tmp_path, monkeypatch):
    """test_pool has one that is made again."""
    monkeypatch.setattr(backends, "ATTEMPTS", 2)
    task = describe("Sledges/Deadly-v0", {"seed": episode_seed(SLEDGE, some().seed, 7)})
    with pytest.raises(
        InputError, match=r"worker that began with episode 7 was killed 2 times, perhaps"
    ):
        collect(some(task), tmp_path / "data", num_threads=2)
    assert len(Dataset(tmp_path / "data").episodes["length"]) <= 7


def test_a_stopped_and_a_killed_collector_are_resumed(long, tmp_path, monkeypatch):
    """In seconds; neither leaves a worker behind, nor changes a byte of what one process gives."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # `environments` is there
    data = tmp_path / "data"
    command = ("collect", "--task", f"environments:{ID}", "--steps", LONG.steps, "--seed", 3)
    command += ("--shard-episodes", 50, "--threads", 2, "--out", data)
    for number, shard, status in ((signal.SIGINT, 1, 130), (signal.SIGKILL, 3, -9)):
        process = start(*command)
        seen = (data / f"shard-{shard:05d}.h5").exists
        assert wait_for(seen, process), process.communicate()
        workers = workers_of(process.pid)
        process.send_signal(number)
        said = process.communicate(timeout=60)[1]
        assert process.returncode == status, said
        assert workers
        wait_for_the_end_of(workers, seconds=60)
        assert "stopped; the same command resumes it" in said or number == signal.SIGKILL
        assert not read_manifest(data).complete
        assert not list(find_problems(data))
    told = jbrep(*command)
    assert told.exit_code == 0, told.output
    assert contents(data) == contents(long)


def test_an_environment_that_fails_ends_the_command_in_one_line(tmp_path):
    """With its id, seed and step; the shards before are kept."""
    seed = episode_seed(SLEDGE, 0, 7)  # in the second shard
    command = ("collect", "--task", "Sledges/Broken-v0", "--env", f"seed={seed}", "--steps", 600)
    command += ("--shard-episodes", 5, "--threads", 2, "--out", tmp_path / "data")
    for _ in range(2):
        told = jbrep(*command)
        line = told.output.strip().splitlines()[-1]
        rows = len(Dataset(tmp_path / "data"))
        assert told.exit_code == 2
        assert line == (
            f"Error: Sledges/Broken-v0 failed at step 4 of the episode with seed {seed}: "
            f"RuntimeError: the rail broke; 5 episodes of {rows} rows are kept"
        )


@pytest.mark.slow
def test_a_shard_that_fails_doesn_t_matter_until_it_is_needed(tmp_path):
    """It was begun ahead of time; the one before it takes longer."""

    arguments = {"seed": episode_seed(SLEDGE, 3, 100)}
    task = describe("Sledges/Broken-v0", arguments)
    wide = some(task, steps=10**6, shard_episodes=100)
    growth = Growth(tmp_path, new_manifest(wide))
    shards = backends.local(Simulator(wide, Uniform(), 1, 2))(growth, lambda steps: None)
    seeds = np.concatenate([next(shards)["episodes/seed"] for _ in range(100)])
    np.testing.assert_array_equal(seeds, wide.seeds(np.arange(100)))
    with pytest.raises(InputError, match="Sledges/Broken-v0 failed at step 4"):
        next(shards)


def test_a_data_set_of_what_is_not_reproducible_says_so(tmp_path):
    data, env_id = tmp_path / "data", "Sledges/Moody-v0"
    command = ("collect", "--task", env_id, "--steps", 90, "--threads", 1, "--out", data)
    told = jbrep(*command)
    assert f"{env_id} is not reproducible: no episode can be simulated again" in told.stderr
    for _ in range(3):  # although a pilot run may end otherwise each time
        assert "already complete" in jbrep(*command).stdout
    assert jbrep("data", "verify", data).exit_code == 0
    told = jbrep("data", "verify", data, "--replay", 1)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    assert f"can't be replayed: {env_id} is not reproducible" in told.output
    assert "note" in jbrep("data", "info", data).output


def test_arrays_of_states_are_stored_and_compared(tmp_path):
    task = describe("Sledges/Told-v0")
    collect(some(task, steps=100, store_state=True), tmp_path / "data", num_threads=1)
    dataset = Dataset(tmp_path / "data")
    np.testing.assert_array_equal(dataset["heat"][:, 0], dataset["step"][:] / 2)
    episodes = dataset.episodes
    np.testing.assert_array_equal(episodes["final_heat"][:, 0], episodes["length"] / 2)
    assert not episodes["initial_heat"].any()
    assert len(np.unique(episodes["colour"][:, 0])) == len(episodes["length"])
    assert not list(replay_problems(dataset, 2))
    with pytest.raises(InputError, match=f"{ID} has no states to store"):
        some(store_state=True)
    for name in ("reward", "length", "policy", "final_heat"):
        with pytest.raises(InputError, match=f"has an array '{name}': data sets have such"):
            some(task.replace(state={name: 1}))


def test_arguments_are_settings(sledges, tmp_path):
    with pytest.raises(InputError, match=r"arguments\.wind none \(now: 0.5\)"):
        collect(some(describe(ID, {"wind": 0.5})), sledges)
    with pytest.raises(InputError, match=r"max_episode_steps 40 \(now: 9\)"):
        collect(some(describe(ID, episode_steps=9)), sledges)
    collect(some(describe(ID, {"wind": 0.5})), tmp_path / "windy", num_threads=1)
    assert (Dataset(tmp_path / "windy")["reward"][:10] != Dataset(sledges)["reward"][:10]).any()


def test_reading_makes_no_environment(tmp_path, monkeypatch):
    """None can be made, found or described then, as where its package isn't installed."""
    folder = tmp_path / "hopper"
    hopper = describe("Hopper-v5", episode_steps=30)
    collect(some(hopper, steps=60), folder, num_threads=1)

    def refuse(*arguments, **keywords):
        raise AssertionError("an environment was asked for")

    for name in ("make", "make_vec", "spec"):
        monkeypatch.setattr(gymnasium, name, refuse)
    monkeypatch.setattr("jbrep.envs.names.import_module", refuse)
    monkeypatch.setattr("jbrep.envs.description._describe", refuse)
    dataset = Dataset(folder)
    assert dataset.task == hopper
    assert dataset["foot_joint_velocity"].shape == (len(dataset),)
    dataset.split()
    assert jbrep("data", "verify", folder).exit_code == 0
    assert "Hopper-v5, 11 features, 3 actions" in jbrep("data", "info", folder).output
    assert jbrep("data", "info", folder, "--json").exit_code == 0
    for to in ("npz", "parquet"):
        export(dataset, to, tmp_path / f"it.{to}")


def test_a_data_set_whose_package_isn_t_imported(sledges, tmp_path, monkeypatch):
    monkeypatch.delitem(gymnasium.registry, ID)
    assert not list(find_problems(sledges))
    out = ("--out", tmp_path / "x")
    for command in (
        ("verify", sledges, "--replay", 1),
        ("export", sledges, "--to", "minari", *out),
    ):
        told = jbrep("data", *command)
        assert (told.exit_code, told.output.count("\n")) == (2, 1)
        assert "--import environments" in told.output
    assert jbrep("data", "derive", sledges, "--history", 2, *out).exit_code == 0
    source, derived = Dataset(sledges), Dataset(tmp_path / "x")
    assert derived.manifest.versions == source.manifest.versions
    assert not list(find_problems(derived.folder))
