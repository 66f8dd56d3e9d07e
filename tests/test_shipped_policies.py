"""The trained policies that ship, wherever a policy is taken."""

import json

import pytest
from command import jbrep, mistake

from jbrep.dataset import Dataset
from jbrep.envs import describe
from jbrep.play.sources import find_episode, find_player
from jbrep.rl.policy_file import FOLDER, SHIPPED, shipped, shipped_file

SHIPS = shipped()


def test_each_file_that_ships_is_listed_with_what_it_returns():
    assert {policy.task for policy in SHIPS} == {path.stem for path in FOLDER.glob("*.safetensors")}
    lines = jbrep("policies").output.splitlines()
    assert [line.split()[0] for line in lines[1 : len(SHIPS) + 1]] == [
        policy.task for policy in SHIPS
    ]
    assert lines[-1].startswith("falling: the preset wide, but with")  # in a learner's name


@pytest.mark.parametrize("policy", SHIPS, ids=lambda policy: policy.task)
def test_it_returns_what_the_table_says(policy):
    """Rounding parts long episodes, so that single returns differ between processors."""
    known = policy.returns[SHIPPED]
    played = find_player(SHIPPED, describe(policy.task)).returns(2)
    assert abs(played.mean() - known[:2].mean()) < 2 * known.std() + 20


def test_it_collects_and_is_kept_with_the_data(tmp_path):
    command = ("collect", "--task", "face_direction", "--steps", 300, "--episode-steps", 100)
    told = jbrep(*command, "--policy", "uniform:0.5+trained:0.5", "--out", tmp_path / "data")
    assert told.exit_code == 0, told.output
    (_, _), (_, kept) = Dataset(tmp_path / "data").manifest.settings.policy["parts"]
    assert kept["run"] == SHIPPED
    assert (tmp_path / "data" / kept["file"]).read_bytes() == shipped_file(
        "face_direction"
    ).read_bytes()
    assert jbrep("data", "verify", tmp_path / "data", "--replay", 3).exit_code == 0


def test_it_plays_with_other_bodies_and_time_limits():
    played = ("evaluate-policy", SHIPPED, "--task", "face_direction", "--episodes", 1, "--json")
    played += ("--episode-steps", 20)
    (other,) = json.loads(jbrep(*played, "--env", "body=7").output)["returns"]
    (usual,) = json.loads(jbrep(*played).output)["returns"]
    assert 0 <= other <= 20
    assert other != usual
    assert find_episode(SHIPPED, 2, describe("face_direction", episode_steps=20)).name == SHIPPED


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("inspect", SHIPPED), "policy trained needs a --task"),
        (("evaluate-policy", SHIPPED, "--task", "Pendulum-v1"), "no trained policy ships for"),
        (("evaluate-policy", SHIPPED, "--encoder", "dae-8"), "which has its own encoder"),
        (("evaluate-policy", "walks"), "constant, ornstein-uhlenbeck, trained"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(command, message):
    assert message in mistake(*command)
