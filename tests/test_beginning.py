"""Runs that begin with another run's policy: what comes along, and what has to be equal."""

import hashlib
import json
import pickle
import shutil
import zipfile
from pathlib import Path

import cart
import pytest
import torch
from command import jbrep

from jbrep.envs import describe
from jbrep.errors import DamageError, InputError
from jbrep.rl import Run, StoppedError, train
from jbrep.rl.files import BEGINNING, POLICY, RUN, read_evaluations, read_run
from jbrep.rl.policy import load_run, load_untrained

CART = describe(cart.ID)
SETTINGS = {
    "task": CART,
    "algorithm": "sac",
    "preset": "modern",
    "evaluation_episodes": 2,
    "final_episodes": 2,
}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A run whose policy has been updated."""
    folder = tmp_path_factory.mktemp("runs") / "source"
    train(Run(**SETTINGS, steps=1016), folder)
    return folder


@pytest.fixture(scope="module")
def later(source):
    """A run that begins with it, and makes no update: it ends before learning starts."""
    folder = source.with_name("later")
    train(Run(**SETTINGS, seed=1, steps=40, begin_from=str(source)), folder)
    return folder


def copy_of(folder, to):
    return Path(shutil.copytree(folder, to))


def weights(trained):
    return trained.policy.state_dict()


def returns_at(folder, step):
    return [row.episode_return for row in read_evaluations(folder) if row.step == step]


def test_all_of_the_policy_comes_along(source, later):
    """Actor, critics and their targets; the entropy coefficient starts anew."""
    there = weights(load_run(source))
    assert {name.partition(".")[0] for name in there} == {"actor", "critic", "critic_target"}
    untrained = weights(load_untrained(source))
    assert any(not there[name].equal(untrained[name]) for name in there)
    for ours in (weights(load_untrained(later)), weights(load_run(later))):
        assert {*ours} == {*there}
        assert all(ours[name].equal(there[name]) for name in there)
    assert returns_at(later, 0) == returns_at(source, 1016)
    with zipfile.ZipFile(later / POLICY) as file, file.open("pytorch_variables.pth") as variables:
        assert torch.load(variables, weights_only=True)["log_ent_coef"].item() == 0


def test_the_policy_is_part_of_what_decides_a_run(source, later, tmp_path):
    sha256 = read_run(source)["policy_sha256"]
    assert read_run(later)["settings"]["from"] == sha256
    assert read_run(source)["settings"]["from"] is None
    before = (later / RUN).read_bytes()
    with pytest.raises(InputError, match=rf"holds another run: from {sha256[:37]}\.\.\. \(now: No"):
        train(Run(**SETTINGS, seed=1, steps=40), later)
    assert train(Run(**SETTINGS, seed=1, steps=40, begin_from=str(source)), later)
    assert (later / RUN).read_bytes() == before


def test_it_is_resumed_to_the_same_bits(source, later, tmp_path):
    run = Run(**SETTINGS, seed=1, steps=40, begin_from=str(source))
    with pytest.raises(StoppedError):
        train(run, tmp_path, stop=iter([False] * 5 + [True]).__next__)
    assert load_untrained(tmp_path).task == CART
    train(run, tmp_path)
    for name in (POLICY, BEGINNING, "evaluations.csv"):
        assert (tmp_path / name).read_bytes() == (later / name).read_bytes()


def test_other_arguments_are_another_body(source, tmp_path):
    other = ("--task", cart.ID, "--env", "fail_seed=5", "--algorithm", "sac", "--preset", "modern")
    told = jbrep(
        "rl",
        *other,
        "--steps",
        8,
        "--evaluation-episodes",
        1,
        "--from",
        source,
        "--out",
        tmp_path / "run",
    )
    assert told.exit_code == 0, told.output
    assert read_run(tmp_path / "run")["settings"]["from"] == read_run(source)["policy_sha256"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"algorithm": "td3"}, r"algorithm sac \(now: td3\)$"),
        ({"preset": "paper"}, r"hidden \[256, 256\] \(now: \[350, 250\]\)$"),
        (
            {"task": "Pendulum-v1"},
            r"features 2 \(now: 3\), latent 2 .* actions 2 \(now: 1\)",
        ),
        ({"begin_from": "nowhere"}, "no finished run in nowhere"),
    ],
)
def test_what_a_run_can_not_begin_with(changes, message, source, tmp_path):
    run = Run(**{**SETTINGS, "begin_from": str(source), **changes})
    with pytest.raises(InputError, match=message):
        train(run, tmp_path / "new")
    assert not (tmp_path / "new").exists()


class Trap:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_of_the_other_run_is_run_as_code(source, tmp_path):
    folder, sprung = copy_of(source, tmp_path / "source"), tmp_path / "sprung"
    with zipfile.ZipFile(folder / POLICY, "w") as file:
        file.writestr("policy.pth", pickle.dumps(Trap(sprung), protocol=2))
    run = Run(**SETTINGS, steps=40, begin_from=str(folder))
    with pytest.raises(DamageError, match=r"its SHA-256 isn't in run\.json"):
        train(run, tmp_path / "new")
    record = json.loads((folder / RUN).read_text())
    record["policy_sha256"] = hashlib.sha256((folder / POLICY).read_bytes()).hexdigest()
    (folder / RUN).write_text(json.dumps(record))
    with pytest.raises(DamageError, match="holds no policy's weights"):
        train(run, tmp_path / "new")
    assert not sprung.exists()
