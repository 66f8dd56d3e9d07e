"""Features, starts and rewards, against values worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from jbrep.jitterbug import tasks
from jbrep.jitterbug.tasks import TASKS, Readings


def about_z(yaw):
    return np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


def readings(position=(0, 0, 0.035), yaw=0.0, tilt=0.0, velocity=(0, 0, 0), target=(0, 0), aim=0.0):
    """One robot: turned by yaw about z, then tilted about its own x axis."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    qpos = np.zeros((1, 16))
    qpos[0, :3], qpos[0, 3:7] = position, about_z(yaw)
    return Readings(
        qpos,
        np.arange(15.0)[None],
        (turn @ lean).reshape(1, 9),
        np.array([velocity], dtype=float),
        np.array([[*target, 0.035]]),
        tasks.yaw_direction(about_z(aim)[None]),
    )


def reward(task, **state):
    return TASKS[task].reward(readings(**state))[0]


def test_shared_features_are_states():
    state = readings(position=(1, 2, 3), yaw=0.4)
    observation = TASKS["move_from_origin"].observe(state)[0]
    np.testing.assert_array_equal(observation[:3], [1, 2, 3])
    np.testing.assert_array_equal(observation[3:7], about_z(0.4))
    np.testing.assert_array_equal(observation[7:13], np.arange(6))
    np.testing.assert_allclose(observation[13:], [np.pi / 2, 14])


@pytest.mark.parametrize("turns", [-3, 0, 2])
def test_the_motor_angle_is_wrapped_and_zero_forward(turns):
    state = readings()
    state.qpos[0, 15] = 2 * np.pi * turns - np.pi / 2  # the weight in front, on -Y
    assert state.motor_angle[0] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("yaw", "aim", "angle"),
    [
        (0, -np.pi / 2, 0),  # the face is on -Y
        (np.pi / 2, 0, 0),
        (np.pi / 2, 1, 1),
        (0, 0, np.pi / 2),
        (0, np.pi / 2 - 0.01, np.pi - 0.01),
        (-3, 3, 6 + np.pi / 2 - 2 * np.pi),
    ],
)
def test_angle_to_target(yaw, aim, angle):
    assert readings(yaw=yaw, aim=aim).angle_to_target[0] == pytest.approx(angle)


def test_angle_to_target_is_blind_to_pitch():
    tilted = readings(yaw=0.3, tilt=0.5, aim=1).angle_to_target
    assert tilted[0] == pytest.approx(readings(yaw=0.3, aim=1).angle_to_target[0])


def test_the_target_seen_from_the_bug():
    # turned by 90 degrees the bug faces +X: a target ahead is on its -Y, one at +Y on its left, +X
    for target, seen in (((0.2, 0), (0, -0.2, 0)), ((0, 0.2), (0.2, 0, 0))):
        found = readings(yaw=np.pi / 2, target=target).target_in_bug_frame[0]
        np.testing.assert_allclose(found, seen, atol=1e-12)


def test_velocity_in_target_frame():
    state = readings(velocity=(0, 0.3, 0.1), aim=np.pi / 2)
    np.testing.assert_allclose(state.velocity_in_target_frame[0], [0.3, 0, 0.1], atol=1e-12)


def test_rewards_where_they_are_known():
    facing = np.pi / 2  # the yaw at which the bug faces +X
    assert reward("move_from_origin") == 0
    assert reward("move_from_origin", position=(0.05, 0, 0.035)) == pytest.approx(0.9)
    assert reward("face_direction", yaw=facing) == pytest.approx(1)
    assert reward("face_direction", yaw=facing, aim=np.pi / 4) == pytest.approx(0.5)
    assert reward("face_direction", yaw=facing, aim=2) == 0
    assert reward("move_in_direction", velocity=(0.05, 9, 0)) == pytest.approx(0.5)
    assert reward("move_in_direction", velocity=(0.2, 0, 0)) == 1
    assert reward("move_in_direction", velocity=(-0.2, 0, 0)) == 0
    assert reward("move_to_position", target=(0.03, 0.04)) == pytest.approx(0.1)
    assert reward("move_to_position", position=(0, 0, 0.085)) == pytest.approx(0.1)  # in 3-D
    assert reward("move_to_pose", yaw=facing, aim=np.pi / 4, target=(0.05, 0)) == pytest.approx(
        0.05
    )


def test_terms_are_dm_control_s_tolerance():
    """Over all values that occur; `tolerance` is the definition."""
    tolerance = pytest.importorskip("dm_control.utils.rewards").tolerance
    random = np.random.default_rng(0)
    turn = random.uniform(-4, 4, 1000)
    state = replace(
        readings(),
        rotation=random.uniform(-1, 1, (1000, 9)),
        velocity=random.normal(0, 0.2, (1000, 3)),
        target_position=random.normal(0, 0.1, (1000, 3)),
        target_axis=np.stack([np.cos(turn), np.sin(turn)], axis=1),
    )
    position = tolerance(state.distance_to_target, (0, 0), 0.05)
    heading = tolerance(state.angle_to_target, (0, 0), np.pi / 2, "cosine", 0)
    velocity = tolerance(
        state.velocity_in_target_frame[:, 0], (0.1, np.inf), 0.1, "linear", value_at_margin=0
    )
    for term, expected in (
        (tasks.upright_term, tolerance(state.uprightness, (1, 1), 0.5)),
        (tasks.position_term, position),
        (tasks.away_term, 1 - position),
        (tasks.heading_term, heading),
        (tasks.velocity_term, velocity),
    ):
        np.testing.assert_allclose(term(state), expected, rtol=0, atol=1e-14)
        assert np.ptp(expected) > 0.5


@pytest.mark.parametrize("task", TASKS)
def test_tilting_costs_reward(task):
    best = {"position": (1, 0, 0.035)} if task == "move_from_origin" else {"velocity": (1, 0, 0)}
    upright, tilted = (reward(task, yaw=np.pi / 2, tilt=tilt, **best) for tilt in (0, np.pi / 3))
    assert upright == pytest.approx(1)
    assert tilted == pytest.approx(0.1)


def starts(task, count=2000, seed=0):
    random = np.random.default_rng(seed)
    return [
        np.array(column)
        for column in zip(*(TASKS[task].start(random) for _ in range(count)), strict=True)
    ]


def test_the_start_is_a_turn_about_a_nearly_upright_axis():
    quaternion, _, _ = starts("move_from_origin")
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1)
    axis = quaternion[:, 1:] / np.linalg.norm(quaternion[:, 1:], axis=1, keepdims=True)
    tilt = np.abs(axis[:, :2] / axis[:, 2:])
    assert 0.024 < tilt.max() <= 0.025
    turn = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])
    counts, _ = np.histogram(turn, bins=8, range=(-np.pi, np.pi))
    assert counts.min() > 190  # 250 expected


@pytest.mark.parametrize("task", TASKS)
def test_targets(task):
    _, position, quaternion = starts(task)
    radius = np.hypot(*position[:, :2].T)
    yaw = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])
    np.testing.assert_array_equal(position[:, 2], 0.035)
    if task in ("move_to_position", "move_to_pose"):
        assert 0.05 <= radius.min() < 0.052
        assert 0.198 < radius.max() <= 0.2
    else:
        assert radius.max() == 0
    turned = task in ("face_direction", "move_in_direction", "move_to_pose")
    assert np.ptp(yaw) > 6.2 if turned else np.ptp(yaw) == 0


def test_one_seed_gives_one_motion_whatever_the_task():
    starts_of = [TASKS[task].start(np.random.default_rng(3)) for task in TASKS]
    for start in starts_of[1:]:
        np.testing.assert_array_equal(start.quaternion, starts_of[0].quaternion)
