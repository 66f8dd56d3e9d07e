"""The scripted policies: pure functions of the observation that reach their returns."""

import numpy as np
import pytest

from jbrep.envs import Environments, describe
from jbrep.envs.recording import episode_returns
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import TASKS

LEAST = {
    "move_from_origin": 950,
    "face_direction": 930,
    "move_in_direction": 640,
    "move_to_position": 850,
    "move_to_pose": 500,
}


@pytest.mark.parametrize("task", TASKS)
def test_median_return_of_four_episodes(task):
    assert (
        np.median(episode_returns(Environments(describe(task), 4), HEURISTICS[task])) >= LEAST[task]
    )


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
