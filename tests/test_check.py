"""What `jbrep check` finds: each planted fault and nothing else, in play and in data."""

import json
from functools import cache

import faulty  # registers the robots
import numpy as np
import pytest
from click.testing import CliRunner

import jbrep
from jbrep.checking.features import turn_of
from jbrep.cli import main
from jbrep.coordinates import make_coordinates
from jbrep.errors import InputError
from jbrep.methods.registry import METHODS

SAW = np.cumsum(np.full(300, 0.0537)) % 1
STEPS = 2200  # 200 by each policy


@pytest.fixture(autouse=True, scope="module")
def learning():
    """Regressions that learn, unlike those of other tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jbrep.evaluation.regression._STEPS", 1000)
        yield


@cache
def checked(robot, seed=0):
    return jbrep.check(f"Faulty/{robot}-v0", steps=STEPS, seed=seed)


@pytest.mark.parametrize("robot", faulty.FAULTS, ids=lambda robot: robot.__name__)
def test_a_fault_is_found_and_nothing_else(robot):
    found = [(each.kind, each.features) for each in checked(robot.__name__).findings]
    if (fault := faulty.FAULTS[robot]) is None:
        assert found == []
        return
    ((kind, features),) = found
    assert kind == fault[0]
    assert fault[1] in (None, features)


def test_what_lacks_is_named_with_the_history_that_has_it():
    (late,), (hidden,) = checked("Delayed").findings, checked("Hidden").findings
    assert (late.numbers["lag"], late.numbers["history"]) == (2, 3)
    assert "speed" not in hidden.features
    assert hidden.numbers["r2_of_history"] > 0.8 > 0.6 > hidden.numbers["r2"]
    assert f"--history={hidden.numbers['history']}" in checked("Hidden").advice.command


def test_policies_that_ignore_the_state_are_beside_their_intervals():
    check = checked("Arm")
    for name, (mean, low, high, episodes) in check.returns.items():
        assert episodes >= 4, name
        assert low < mean < high, name
    assert {*check.spread} == {1, 2, 4, 8, 16}
    assert check.spread[1] == 1.0 < check.spread[8]  # its speed adds up what it is pushed by
    *lines, command = check.text(80).split("\n")
    assert max(map(len, lines)) <= 80
    assert command.startswith("    jbrep rl --task Faulty/Arm-v0")


def test_a_command_writes_what_other_commands_take(tmp_path):
    file, page = tmp_path / "features.toml", tmp_path / "page.html"
    words = ["check", "Faulty/Wrapped-v0", f"--steps={STEPS}", "--json"]
    ran = CliRunner().invoke(main, [*words, f"--write={file}", f"--out={page}"])
    assert ran.exit_code == 0, ran.output
    said = json.loads(ran.stdout)
    python = checked("Wrapped").plain()
    assert said["findings"] == python["findings"]  # the same seed finds the same
    assert said["returns"] == python["returns"]
    assert said["representation"] == "coordinates"
    task = jbrep.describe("Faulty/Wrapped-v0", features=file)
    assert task.features[0].is_full_turn
    assert make_coordinates(task, "coordinates").names[:2] == ("heading.cos", "heading.sin")
    text = page.read_text()
    assert text.count("data:image/svg+xml;base64") == 1
    assert "http" not in text.replace("http-equiv", "")
    with pytest.raises(InputError, match=r"features\.toml exists already"):
        jbrep.check("Faulty/Wrapped-v0", write=file)


def test_a_quaternion_and_scales_become_what_a_features_file_says(tmp_path):
    for robot in ("Signs", "Scales"):
        path = tmp_path / robot
        text = checked(robot).features_file
        if robot == "Signs":  # in which order its parts are is the user's to say
            before, *rows = text.split("bounded = true")
            text = before + "".join(row.replace("scalar", "quaternion", 1) for row in rows)
        path.write_text(text)
        task = jbrep.describe(f"Faulty/{robot}-v0", features=path)
        if robot == "Signs":
            assert make_coordinates(task, "coordinates")
        assert all(each.low < each.high for each in task.features)


def test_a_features_file_keeps_zeros_offsets_and_what_is_said_of_the_task(tmp_path):
    first, again = tmp_path / "first.toml", tmp_path / "again.toml"
    first.write_text(
        'timestep = 0.5\nreward_high = 1.0\n[[features]]\nname = "heading"\n[[features]]\n'
        'name = "speed"\noffset = 3.0\n[[features]]\nname = "tilt"\nlow = 0.0\nhigh = 1.0\n'
    )
    task = jbrep.describe("Faulty/Turned-v0", features=first)
    jbrep.check(task, steps=STEPS, write=again)
    found = jbrep.describe("Faulty/Turned-v0", features=again)
    assert found.features[0].is_full_turn
    assert found.features[0].low == found.features[2].low == 0
    assert (found.offsets, found.timestep, found.reward_high) == ({"speed": 3.0}, 0.5, 1.0)


def test_a_robot_on_which_nothing_moves_is_told_so():
    told = checked("Dead")
    assert {each.kind for each in told.findings} >= {"constant"}
    assert told.spread == told.plain()["spread"] == {}
    assert "move nothing" in told.text(80)


def test_data_are_read_in_place_of_play(tmp_path):
    data = jbrep.collect("Faulty/Wrapped-v0", tmp_path / "data", STEPS)
    check = jbrep.check(data=data)
    assert [(each.kind, each.features) for each in check.findings] == [("wraps", ("heading",))]
    assert check.played is None
    (note,) = check.notes
    assert "reproducible" in note
    plain = jbrep.check(data=jbrep.collect("Pendulum-v1", tmp_path / "plain", STEPS))
    for each, kind in ((check, "coordinates"), (plain, "full")):
        assert f"train-encoder --kind {kind} " in each.advice.command
        assert kind in METHODS
    with pytest.raises(InputError, match="give a task, or else data"):
        jbrep.check("Faulty/Wrapped-v0", data=data)


def test_a_robot_of_mujoco_is_turned_and_shifted():
    check = jbrep.check("face_direction", steps=500)
    kinds = {each.kind: each for each in check.findings}
    assert "position_x" in kinds["world"].features
    assert "motor_angle" not in kinds["world"].features
    assert check.advice.representation == "symmetry"


@pytest.mark.parametrize(
    ("values", "turn"),
    [
        (np.cumsum(np.full(200, 0.3)) % (2 * np.pi), (0, 2 * np.pi)),
        (np.degrees(np.cumsum(np.full(200, 0.3))) % 360 - 180, (-180, 360)),
        (SAW, (SAW.min(), np.ptp(SAW))),
        (np.cumsum(np.full(200, 0.3)), None),  # many turns, none of which is lost
        (np.tile([0.0] * 10 + [1.0] * 10, 10), None),  # a switch
        (np.random.default_rng(0).uniform(-np.pi, np.pi, 200), None),  # noise
        (3 * np.sin(np.arange(200) / 5), None),
    ],
)
def test_a_jump_is_by_a_full_turn_of_what_moves_little_otherwise(values, turn):
    found = turn_of(values[:-1], values[1:])
    assert (found and (found.low, found.size)) == (turn and pytest.approx(turn))
