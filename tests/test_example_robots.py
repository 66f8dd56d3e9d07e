"""The robots of examples/robots: what check finds of them, and that their study can start."""

from pathlib import Path

import pytest

import jbrep
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
    monkeypatch.chdir(FOLDER)
    import mybots

    return mybots


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
    assert {"--import=mybots", *options} <= {*given}
    if not options:
        assert not [each for each in given if each.startswith(("--action", "--episode"))]


def test_their_study_can_start(tmp_path):
    plan = Plan(read_study(FOLDER / "study.toml"), tmp_path)
    assert len(plan.cells) == 24
    check(plan)
