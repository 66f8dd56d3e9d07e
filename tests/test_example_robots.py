"""The robots of examples/robots: what check finds of them, and that their study can start."""

from pathlib import Path

import pytest

import jbrep
from jbrep.collecting.derive import derive
from jbrep.encoders import find
from jbrep.envs.names import import_modules
from jbrep.evaluation.diagnosis import diagnose
from jbrep.studies.config import read_study
from jbrep.studies.plan import Plan
from jbrep.studies.prepare import check

FOLDER = Path(__file__).parent.parent / "examples/robots"
TURNED = {"wraps": ("heading",), "world": ("heading",)}


@pytest.fixture(autouse=True)
def learning(monkeypatch):
    """Regressions that learn, unlike those of other tests."""
    monkeypatch.setattr("jbrep.evaluation.regression._STEPS", 1000)


@pytest.fixture(autouse=True)
def robots(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    monkeypatch.chdir(FOLDER)
    import_modules(["mybots", "reacher", "made_up"])


@pytest.mark.parametrize(
    ("name", "how", "found", "recommended", "options"),
    [
        ("Balancer-v0", {}, {"wraps": ("heading",)}, "coordinates", ()),
        (
            "UnboundedBalancer-v0",
            {"features": "balancer.toml", "action_bounds": "-1..1", "episode_steps": 150},
            TURNED,
            "symmetry",
            ("--action-bounds=-1..1", "--episode-steps=150", "--features=features.toml"),
        ),
        ("RawCartPole-v0", {}, {"wraps": ("obs_2",)}, "coordinates", ("--features=features.toml",)),
        ("AcroCart-v0", {}, {"winds": ("elbow",)}, "coordinates", ()),
        (
            "RawReacher-v0",
            {"features": "reacher.toml"},
            {"winds": ("shoulder",), "world": ("shoulder", "finger_x", "finger_y")},
            "symmetry",
            ("--features=features.toml",),
        ),
    ],
)
def test_what_is_found_of_a_robot_and_what_its_command_needs(
    name, how, found, recommended, options
):
    made = jbrep.check(jbrep.describe(name, **how), steps=4_400)
    kinds = dict.fromkeys(dict.fromkeys(each.kind for each in made.findings), ())
    for each in made.findings:
        kinds[each.kind] += each.features
    assert kinds == found
    assert made.advice.representation == recommended
    given = made.advice.command.split()
    module = "reacher" if "Reacher" in name else "mybots"
    assert {f"--import={module}", *options} <= {*given}
    if not options:
        assert not [each for each in given if each.startswith(("--action", "--episode"))]


@pytest.mark.parametrize(("file", "runs"), [("study.toml", 24), ("arm.toml", 50)])
def test_their_studies_can_start(file, runs, tmp_path):
    plan = Plan(read_study(FOLDER / file), tmp_path)
    assert len(plan.cells) == runs
    check(plan)


def test_places_in_the_world_are_needed_where_the_reward_needs_them(tmp_path):
    task = jbrep.describe("RawReacher-v0", features="reacher.toml")
    jbrep.collect(task, tmp_path / "near", 8_000, policy="reacher:reach")
    derive(tmp_path / "near", tmp_path / "there", reward="made_up:reached")
    places = {"finger_x", "finger_y", "target_x", "target_y"}
    needs = {data: diagnose({}, tmp_path / data).needs for data in ("near", "there")}
    assert max(needs["near"][name] for name in places) < 0.1 < needs["there"]["finger_x"]


def test_turned_and_shifted_the_arm_has_the_same_symmetry():
    task = jbrep.describe("RawReacher-v0", features="reacher.toml")
    assert find("symmetry", task).latent_size == 9  # no notice: some reward differs
