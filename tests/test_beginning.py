"""Runs that begin with another run's policy: what comes along, and what has to be equal."""

import zipfile

import cart
import numpy as np
import pytest
import torch
from behaviour import untrained
from small import assert_same_files

from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.records import container
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.files import BEGINNING, POLICY, POLICY_ZIP, RUN, read_evaluations, read_run
from jbrep.rl.policy import load_run

CART = describe(cart.ID)
SETTINGS = {"task": CART, "algorithm": "sac", "preset": "modern"}
SETTINGS |= {"evaluation_episodes": 2, "final_episodes": 2}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run whose policy has been updated."""
    folder = tmp_path_factory.mktemp("runs") / "source"
    train(Run.of(**SETTINGS, steps=1016), folder)
    return folder


@pytest.fixture(scope="module")
def later(source):
    """A run that begins with it, and makes no update: it ends before learning starts."""
    folder = source.with_name("later")
    train(Run.of(**SETTINGS, seed=1, steps=40, begin_from=str(source)), folder)
    return folder


def weights(trained):
    return trained.policy.state_dict()


def returns_at(folder, step):
    return [row.episode_return for row in read_evaluations(folder) if row.step == step]


def test_all_of_the_policy_comes_along(source, later):
    """Actor, critics and their targets; the entropy coefficient starts anew."""
    there, ours, first = (
        container.read(folder / name, "policy")[0]
        for folder, name in ((source, POLICY), (later, POLICY), (later, BEGINNING))
    )
    parts = {"policy", "training", "encoder"}
    assert {name.partition(".")[0] for name in there} == parts
    assert {n.split(".")[1] for n in there if n[0] == "t"} == {"critic", "critic_target"}
    for each in (ours, first):
        assert {*each} == {*there}
        assert all(np.array_equal(each[name], there[name]) for name in there)
    before, after = (weights(load(source)) for load in (untrained, load_run))
    assert any(not before[name].equal(after[name]) for name in before if "actor" in name)
    assert weights(untrained(later))["actor.mu.weight"].equal(after["actor.mu.weight"])
    assert returns_at(later, 0) == returns_at(source, 1016)
    with (
        zipfile.ZipFile(later / POLICY_ZIP) as file,
        file.open("pytorch_variables.pth") as variables,
    ):
        assert torch.load(variables, weights_only=True)["log_ent_coef"].item() == 0


def test_the_policy_is_part_of_what_decides_a_run(source, later, tmp_path):
    sha256 = read_run(source).policy_sha256
    assert read_run(later).settings.begin_from == sha256
    assert read_run(source).settings.begin_from is None
    before = (later / RUN).read_bytes()
    with pytest.raises(InputError, match=rf"holds another run: from {sha256[:37]}\.\.\. \(now: no"):
        train(Run.of(**SETTINGS, seed=1, steps=40), later)
    assert train(Run.of(**SETTINGS, seed=1, steps=40, begin_from=str(source)), later)
    assert (later / RUN).read_bytes() == before


def test_it_is_resumed_to_the_same_bits(source, later, tmp_path):
    run = Run.of(**SETTINGS, seed=1, steps=40, begin_from=str(source))
    with pytest.raises(StoppedError):
        train(run, tmp_path, Session(stop=iter([False] * 5 + [True]).__next__))
    assert untrained(tmp_path).task == CART
    train(run, tmp_path)
    assert_same_files(tmp_path, later, POLICY, BEGINNING, "evaluations.csv")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "td3"}, "algorithm"),
        ({"preset": "paper"}, "net_arch"),
        ({"task": "Pendulum-v1"}, "features .* latent .* actions"),
        ({"begin_from": "nowhere"}, "nowhere"),
    ],
)
def test_what_a_run_can_not_begin_with(changes, message, source, tmp_path):
    run = Run.of(**{**SETTINGS, "begin_from": str(source), **changes})
    with pytest.raises(InputError, match=message):
        train(run, tmp_path / "new")
    assert not (tmp_path / "new").exists()
