"""Data sets of mixtures: bytes that depend on nothing else, and a column that says who acted."""

import numpy as np
import pytest
from command import jbrep
from small import contents, settings

from jbrep.collecting import collect
from jbrep.collecting.policies import parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import find_problems
from jbrep.envs import describe
from jbrep.envs.names import import_modules

import_modules(["environments"])
OPEN = "uniform:0.4+ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3:0.3+constant:drive=0.5:0.3"


def mixed(task="face_direction"):
    short = describe(task, episode_steps=60)
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
    collect(mixed(), tmp_path / "data", num_envs=3, num_threads=2)
    assert contents(tmp_path / "data") == contents(mixture)


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
