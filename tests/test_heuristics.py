"""The hand-written policies: pure functions of the observation that reach their returns."""

import numpy as np
import pytest

from jbrep.envs import Lanes, describe
from jbrep.envs.recording import episode_returns
from jbrep.jitterbug.heuristics import HEURISTICS, TURN, WALK, turn_by, walk_toward
from jbrep.jitterbug.tasks import TASKS

LEAST = {
    "move_from_origin": 950,
    "face_direction": 930,
    "move_in_direction": 640,
    "move_to_position": 850,
    "move_to_pose": 500,
}


def state(motor_angle, motor_velocity, turning=0.0):
    return {
        "motor_angle": np.array([[motor_angle]]),
        "motor_velocity": np.array([[motor_velocity]]),
        "velocity": np.zeros((1, 3)),
        "angular_velocity": np.array([[0, 0, turning]]),
    }


@pytest.mark.parametrize("task", TASKS)
def test_median_return_of_four_episodes(task):
    assert np.median(episode_returns(Lanes(describe(task), 4), HEURISTICS[task])) >= LEAST[task]


@pytest.mark.parametrize("task", TASKS)
def test_policies_are_functions_of_the_observation_alone(task):
    observation = np.random.default_rng(0).normal(size=(20, TASKS[task].plain.size))
    kept = observation.copy()
    action = HEURISTICS[task](observation)
    assert action.shape == (20, 1)
    assert np.abs(action).max() <= 1
    np.testing.assert_array_equal(observation, kept)
    for row in (0, 7):
        one = HEURISTICS[task](observation[row : row + 1])
        np.testing.assert_allclose(one[0], action[row], rtol=1e-12)


def test_the_swing_is_driven_through_the_bearing_and_turned_back_beyond_it():
    bearing = np.array([[0.5]])
    for side in (1, -1):
        assert side * walk_toward(state(0.5, side * 40.0), bearing, WALK)[0, 0] > 0.3
        beyond = state(0.5 + side * (np.pi / 2 + WALK.late * 20), side * 20.0)
        assert side * walk_toward(beyond, bearing, WALK)[0, 0] < -0.2


def test_turning_goes_by_the_shorter_side_and_rests_when_near():
    def drive(angle, **motion):
        return turn_by(state(0.0, **motion), np.array([[angle]]), TURN)[0, 0]

    assert drive(1.0, motor_velocity=0.0) == TURN.burst == -drive(-1.0, motor_velocity=0.0)
    assert drive(1.0, motor_velocity=TURN.fast + 1) == TURN.coast
    assert drive(TURN.near / 2, motor_velocity=0.0) == 0
    assert drive(0.5, motor_velocity=0.0, turning=0.5 / TURN.ahead) == 0  # it turns there anyway
