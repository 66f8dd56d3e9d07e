"""Coordinates: the same state without jumps, the way back, and what turning the world leaves."""

from collections import Counter

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec

from jbrep.coordinates import make_coordinates
from jbrep.coordinates.formulas import FORMULAS
from jbrep.coordinates.invariance import check_invariant
from jbrep.coordinates.placing import continuous, nearest, placed
from jbrep.encoders import find
from jbrep.envs.description import describe
from jbrep.envs.task import Feature
from jbrep.envs.view import with_view
from jbrep.errors import InputError, Notice
from jbrep.jitterbug.tasks import TASKS

TASK = TASKS["move_to_pose"].plain
ANGLES = ("motor_angle", "angle_to_target")


def states(task, count=200, seed=0):
    """Observations with any attitude and all angles."""
    random = np.random.default_rng(seed)
    rows = task.unscale(random.uniform(-1, 1, (count, task.size)))
    quaternion = random.normal(size=(count, 4))
    quaternion *= np.sign(quaternion[:, :1]) / np.linalg.norm(quaternion, axis=1, keepdims=True)
    rows[:, task.groups["orientation"]] = quaternion
    return rows


def turn(rows, task, angle, shift=(0.0, 0.0)):
    """The same robot and target, turned about the vertical and shifted."""
    rows, groups = rows.copy(), task.groups
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    for name in ("position", "velocity"):
        plane = slice(groups[name].start, groups[name].start + 2)
        rows[:, plane] = rows[:, plane] @ rotation + (shift if name == "position" else 0)
    w, x, y, z = rows[:, groups["orientation"]].T
    cosine, sine = np.cos(angle / 2), np.sin(angle / 2)
    rows[:, groups["orientation"]] = np.column_stack(
        (cosine * w - sine * z, cosine * x - sine * y, cosine * y + sine * x, cosine * z + sine * w)
    )
    return rows


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("system", ["angles", "coordinates"])
def test_coordinates_lose_nothing(name, system):
    task = TASKS[name].plain
    made, rows = make_coordinates(task, system), states(TASKS[name].plain)
    assert not made.not_decoded
    np.testing.assert_allclose(made.inverse(made.forward(rows)), rows, atol=2e-4)


@pytest.mark.parametrize("system", ["coordinates", "symmetry"])
@pytest.mark.parametrize("near", [0, 1e-4, 1])
def test_a_robot_on_its_back_stays_there(near, system):
    about, w, z = np.random.default_rng(0).uniform(-1, 1, (3, 200))
    columns = np.array([near * w, np.cos(np.pi * about), np.sin(np.pi * about), near * z])
    columns /= np.linalg.norm(columns, axis=0)
    place, rows = TASK.groups["orientation"], states(TASK)
    rows[:, place] = np.transpose(columns)
    it = find(system, TASK)
    for encoded in (rows.astype(np.float32), torch.from_numpy(rows.astype(np.float32))):
        decoded = np.asarray(it.decode(it.encode(encoded)))[:, place].T
        up = FORMULAS["tilt"].forward
        np.testing.assert_allclose(up(np, decoded, 0), up(np, columns, 0), atol=1e-3)


@pytest.mark.parametrize("system", ["coordinates", "symmetry"])
def test_nothing_jumps_where_an_angle_or_a_quaternion_does(system):
    made, row = make_coordinates(TASK, system), states(TASK, 1)
    yaw, orientation = 1e-4, TASK.groups["orientation"]
    before, after = row.copy(), row.copy()
    for name in ANGLES:
        before[:, TASK.groups[name]], after[:, TASK.groups[name]] = np.pi - 1e-4, -np.pi + 1e-4
    after[:, orientation] *= -1  # the same attitude
    after = turn(after, TASK, yaw)
    near = np.abs(made.forward(after) - made.forward(before)).max()
    assert near < 0.02
    assert np.abs(after - before).max() > 6


def test_a_distance_has_no_corner_at_the_target():
    made = make_coordinates(TASK, "coordinates")
    target = TASK.groups["target"].start
    line = np.repeat(states(TASK, 1), 201, axis=0)
    line[:, target] = np.linspace(-0.1, 0.1, 201)
    line[:, target + 1] = 0
    seen = made.forward(line)[
        :, [made.names.index("target_at.length"), made.names.index("target_at.cos")]
    ]
    bends = np.abs(np.diff(seen, 2, axis=0)).max(axis=0)
    steps = np.abs(np.diff(seen, axis=0)).max(axis=0)
    assert (bends < 0.1 * steps).all()  # of |x| and its sign, a bend would be 1 or 2 steps


@pytest.mark.parametrize("name", TASKS)
def test_symmetry_is_what_turning_and_shifting_leaves(name):
    task = TASKS[name].plain
    made, rows = make_coordinates(task, "symmetry"), states(TASKS[name].plain)
    shift = (0, 0) if name == "move_from_origin" else (1.5, -0.7)
    for angle in (0.3, -2.5, np.pi):
        other = turn(rows, task, angle, shift)
        np.testing.assert_allclose(made.forward(other), made.forward(rows), atol=1e-9)
    seen = make_coordinates(task, "coordinates").forward(turn(rows, task, 1.0))
    assert np.abs(seen - make_coordinates(task, "coordinates").forward(rows)).max() > 0.1


def test_symmetry_gives_back_the_robot_at_the_origin_heading_along_x():
    made, rows = make_coordinates(TASK, "symmetry"), states(TASK)
    back = made.inverse(made.forward(rows))
    np.testing.assert_allclose(made.forward(back), made.forward(rows), atol=2e-4)
    np.testing.assert_array_equal(back[:, :2], 0)
    np.testing.assert_allclose(back[:, TASK.groups["orientation"].stop - 1], 0, atol=1e-9)
    assert set(made.not_decoded) == {"position_x", "position_y", *TASK.feature_names[3:7]}


@pytest.mark.parametrize("name", TASKS)
def test_a_robot_is_put_back_where_it_stood(name):
    task = TASKS[name].plain
    made, rows = make_coordinates(task, "symmetry"), states(TASKS[name].plain)
    back = placed(task, made.inverse(made.forward(rows)), rows)
    np.testing.assert_allclose(nearest(task, back, rows), rows, atol=1e-3)


def test_the_same_states_are_compared_in_the_nearest_numbers():
    task, rows = TASKS["face_direction"].plain, states(TASKS["face_direction"].plain)
    place, angle = task.groups["orientation"], task.feature_names.index("angle_to_target")
    others = rows.copy()
    others[::2, place] *= -1
    others[::3, angle] += 4 * np.pi
    np.testing.assert_allclose(nearest(task, others, rows), rows, atol=1e-12)
    turning = np.linspace(0, 3 * np.pi, 50)
    path = np.repeat(rows[:1], 50, axis=0)
    path[:, place] = np.column_stack((np.cos(turning), 0 * turning, 0 * turning, np.sin(turning)))
    path[:, angle] = (turning + np.pi) % (2 * np.pi) - np.pi
    jumps = path.copy()
    jumps[:, place] *= np.where(path[:, [place.start]] < 0, -1, 1)  # as coordinates give it back
    smooth = continuous(task, jumps)
    np.testing.assert_allclose(smooth[:, place], path[:, place], atol=1e-12)
    np.testing.assert_allclose(smooth[:, angle], turning, atol=1e-9)


@pytest.mark.parametrize(
    ("ingredient", "gone"),
    [
        ("angles", "motor_angle.cos"),
        ("attitude", "orientation.up_x"),
        ("body", "velocity.x"),
        ("distance", "target_at.length"),
        ("phases", "motor_angle-angle_to_target.cos"),
    ],
)
def test_each_ingredient_can_be_left_out(ingredient, gone):
    whole, rows = make_coordinates(TASK, "coordinates"), states(TASK)
    made = make_coordinates(TASK, "coordinates", [ingredient])
    assert gone in whole.names
    assert gone not in made.names
    np.testing.assert_allclose(made.inverse(made.forward(rows)), rows, atol=2e-4)


def test_kinds_follow_from_mujocos_model():
    ant = describe("Ant-v5")
    assert Counter((each.kind, each.frame) for each in ant.features) == {
        ("scalar", ""): 87,  # the height among them, whose x and y aren't seen
        ("quaternion", ""): 4,
        ("angle", ""): 8,
        ("vector", "world"): 3,
        ("vector", "body"): 3,
    }
    assert [each.kind for each in ant.features[:6]] == ["scalar", *["quaternion"] * 4, "angle"]
    swimmer = describe("Swimmer-v5").features
    assert [each.frame for each in swimmer[:5]] == ["world", "", "", "world", "world"]


def test_symmetry_is_refused_whatever_the_unit_of_the_reward():
    only = {"forward_reward_weight": 1e-9, "ctrl_cost_weight": 0, "contact_cost_weight": 0}
    arguments = {**only, "healthy_reward": 0, "include_cfrc_ext_in_observation": False}
    with pytest.raises(InputError, match="the reward is"):
        check_invariant(make_coordinates(describe("Ant-v5", arguments), "symmetry"))


def test_the_jitterbugs_symmetry_holds():
    for each in TASKS.values():
        check_invariant(make_coordinates(each.plain, "symmetry"))


def test_symmetry_is_tried_on_what_is_seen():
    seen = with_view(TASKS["move_in_direction"].plain, ["*velocity*"])
    check_invariant(make_coordinates(seen, "symmetry"))
    past = with_view(TASKS["move_in_direction"].plain, ["*velocity*"], history=3)
    with pytest.raises(
        InputError, match=r"history-3 isn't the same for a turned robot: orientation"
    ):
        check_invariant(make_coordinates(past, "symmetry"))


@pytest.mark.parametrize(
    ("size", "feature", "said"),
    [
        (1, {"unit": "deg", "kind": "angle"}, "in rad"),
        (1, {"unit": "rad", "kind": "angle", "low": -1.0, "high": 1.0, "bounded": True}, "turn"),
        (1, {"kind": "vector"}, "frame"),
        (1, {"kind": "point", "frame": "body"}, "point"),
        (3, {"kind": "quaternion"}, "3 numbers"),
        (5, {"kind": "quaternion"}, "5 numbers"),
        (4, {"kind": "vector", "frame": "body"}, "4 numbers"),
    ],
)
def test_features_that_cant_be(size, feature, said):
    with pytest.raises(InputError, match=said):
        TASK.replace(features=[Feature(f"f{i}", group="g", **feature) for i in range(size)])


class Disc(gymnasium.Env):
    """Where a disc that turns is, and its goal; its reward is how near they are."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (5,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.yaw, self.places = self.np_random.uniform(-3, 3), self.np_random.normal(size=(2, 2))
        return self._seen(), {}

    def step(self, action):
        self.yaw += 0.1 * action[0]
        self.places[0] += 0.1 * action[1] * np.array([np.cos(self.yaw), np.sin(self.yaw)])
        near = -float(np.hypot(*(self.places[0] - self.places[1])))
        return self._seen(), near, False, False, {}

    def quarter_turn(self, shift):
        self.yaw += np.pi / 2
        self.places = self.places @ np.array([[0, 1], [-1, 0]]) + shift
        return True

    def _seen(self):
        return np.array([np.arctan2(np.sin(self.yaw), np.cos(self.yaw)), *self.places.flat])


def test_symmetry_is_tried_on_what_encoders_take(monkeypatch):
    """A place whose numbers are shifted isn't where the others say; nor is it where agents act."""
    features = [Feature("yaw", "rad", kind="angle", frame="world")]
    features += [
        Feature(f"{place}_{axis}", "m", group=place, kind="point", frame="world")
        for place in ("disc", "goal")
        for axis in "xy"
    ]
    spec = EnvSpec("Disc-v0", Disc, max_episode_steps=50)
    monkeypatch.setitem(gymnasium.registry, "Disc-v0", spec)
    task = describe("Disc-v0").replace(features=features)
    check_invariant(make_coordinates(task, "symmetry"))
    shifted = make_coordinates(task.replace(offsets={"goal_x": 3.0}), "symmetry")
    with pytest.raises(InputError, match="use coordinates in place of symmetry"):
        check_invariant(shifted)


BOT = """<body name="bot" pos="0 0 .2"><freejoint/><geom type="box" size=".2 .1 .1"/>
<site name="s"/></body>"""
PUCK = '<body pos="2 2 .1"><freejoint/><geom size=".1" mass=".1"/></body>'
PLANAR = """<body {}><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
<joint axis="0 0 1"/><geom size=".1"/><site name="s"/></body>"""
WINCH = '<body><joint axis="0 0 1" range="{}"/><geom size=".1"/><site name="s"/></body>'


class Made(gymnasium.Env):
    """Bodies that MuJoCo moves, and a thruster; the whole state is seen.

    Args:
        bodies: in MuJoCo's XML.
        far: ends an episode; where along x the robot mustn't be.
        reward: of each step, None for its speed.
        fails: in the step with this number.
        shape: of an action.
    """

    def __init__(self, bodies=BOT, far=9, reward=None, fails=None, shape=(1,)):
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><geom type="plane" size="9 9 .1"/>{bodies}</worldbody>'
            '<actuator><motor site="s" gear="1 0 0 0 0 1"/></actuator></mujoco>'
        )
        self.data = mujoco.MjData(self.model)
        self.far, self.reward, self.fails = far, reward, fails
        self.action_space = gymnasium.spaces.Box(-1, 1, shape)
        size = self.model.nq + self.model.nv
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        mujoco.mj_resetData(self.model, self.data)
        self.data.qvel[:] = self.np_random.uniform(-0.3, 0.3, self.model.nv)
        return self._seen(), {}

    def step(self, action):
        print("moving")
        self.steps += 1
        assert self.action_space.contains(action)
        assert self.steps != self.fails, "the motor is stuck"
        self.data.ctrl = action.flat
        mujoco.mj_step(self.model, self.data, 5)
        speed = float(np.linalg.norm(self.data.qvel[:2]))
        is_far = bool(abs(self.data.qpos[0]) > self.far)
        return self._seen(), speed if self.reward is None else self.reward, is_far, False, {}

    def _seen(self):
        return np.concatenate((self.data.qpos, self.data.qvel))


def made(monkeypatch, **arguments):
    """The task of such bodies."""
    spec = EnvSpec("Made-v0", Made, max_episode_steps=60)
    monkeypatch.setitem(gymnasium.registry, "Made-v0", spec)
    return describe("Made-v0", arguments)


def kinds(task):
    return [each.kind for each in task.features]


def test_the_robot_is_the_heaviest_of_free_bodies(monkeypatch):
    free, other = ["point"] * 3 + ["quaternion"] * 4, ["scalar"] * 7
    assert kinds(made(monkeypatch, bodies=PUCK + BOT))[:14] == other + free
    task = made(monkeypatch, bodies=BOT + PUCK)
    assert kinds(task)[:14] == free + other
    with pytest.raises(InputError, match="it isn't the only free body in MuJoCo"):
        check_invariant(make_coordinates(task, "symmetry"))


@pytest.mark.parametrize(
    ("body", "first"),
    [
        (PLANAR.format(""), ["point", "point", "angle"]),
        (PLANAR.format('euler="90 0 0"'), ["scalar", "scalar", "angle"]),  # in a vertical plane
        (WINCH.format("-180 180"), ["angle", "scalar"]),
        (WINCH.format("-1080 1080"), ["scalar", "scalar"]),
    ],
)
def test_what_joints_mean_depends_on_how_they_stand_and_how_far_they_go(body, first, monkeypatch):
    assert kinds(made(monkeypatch, bodies=body))[: len(first)] == first


def test_rewards_that_are_all_the_same_tell_nothing_of_symmetry(monkeypatch):
    task = made(monkeypatch, reward=0.0)
    with pytest.warns(Notice, match="gave the reward 0 at every step at which symmetry was tried"):
        check_invariant(make_coordinates(task, "symmetry"))


def test_what_fails_while_symmetry_is_tried_is_said_in_one_line(monkeypatch, capsys):
    """An action has the shape of its space, and what is printed is no output."""
    task = made(monkeypatch, shape=(1, 1))
    check_invariant(make_coordinates(task, "symmetry"))
    fails = task.replace(arguments={**task.arguments, "fails": 3})
    with pytest.raises(InputError, match="can't be tried on Made-v0: AssertionError: the motor is"):
        check_invariant(make_coordinates(fails, "symmetry"))
    assert not capsys.readouterr().out


def test_a_task_whose_features_say_nothing():
    plain = TASK.replace(features=[each.replace(kind="scalar", frame="") for each in TASK.features])
    with pytest.raises(InputError, match="would be the observation"):
        make_coordinates(plain, "coordinates")
    with pytest.raises(InputError, match="symmetry has nothing to leave out"):
        make_coordinates(plain, "symmetry")


def test_an_angle_is_given_back_in_its_range():
    turning = Feature("knee", "rad", 0.0, 4.7, kind="angle")
    task = TASK.whole.replace(features=(turning, *TASK.features))
    coordinates = make_coordinates(task, "angles")
    rows = np.insert(states(TASK, 3), 0, (3.0, 3.2, 4.5), axis=1)
    np.testing.assert_allclose(coordinates.inverse(coordinates.forward(rows))[:, 0], rows[:, 0])
