"""Lanes are independent, bit for bit, whatever their number and that of the threads."""

import numpy as np
import pytest

from jbrep.envs.checks import NonFiniteActionError, check_actions
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import get_task

STEPS = 150


def rollout(seeds, num_threads, task="move_to_pose", spoil=None):
    """Observations, rewards and divergence of each seed's lane, (T, n, ...)."""
    simulation = Simulation(get_task(task), len(seeds), num_threads)
    simulation.reset(range(len(seeds)), [np.random.default_rng(seed) for seed in seeds])
    actions = np.stack(
        [np.random.default_rng([seed, 1]).uniform(-1, 1, (STEPS, 1)) for seed in seeds], 1
    )
    tape = []
    for step, action in enumerate(actions):
        if spoil and step == 100:
            spoil(simulation)
        diverged = simulation.step(action)
        tape.append((simulation.observe(), simulation.reward(), diverged))
    return tuple(np.array(column) for column in zip(*tape, strict=True))


def assert_same(one, other, lanes=slice(None), of=slice(None)):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a[:, lanes], b[:, of])


def test_any_number_of_threads_gives_the_same():
    one = rollout(range(5), 1)
    assert np.abs(np.diff(one[0], axis=0)).max() > 0.1
    assert_same(one, rollout(range(5), 2))
    assert_same(one, rollout(range(5), 7))


def test_any_number_of_lanes_gives_the_same():
    many = rollout(range(16), 2)
    for seed in (0, 3, 15):
        assert_same(many, rollout([seed], 1), lanes=slice(seed, seed + 1))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_a_lane_that_diverges_says_so_and_leaves_the_others_alone(value):
    def spoil(simulation):
        simulation.readings.qvel[1, 4] = value

    whole, spoilt = rollout(range(3), 2), rollout(range(3), 2, spoil=spoil)
    assert_same(whole, spoilt, [0, 2], [0, 2])
    assert not whole[2].any()
    assert not spoilt[2][:100].any()
    assert spoilt[2][100, 1]
    assert np.isfinite(spoilt[0]).all()


def test_a_reset_leaves_nothing_of_the_episode_before():
    simulation = Simulation(get_task("face_direction"), 2, 1)

    def episode():
        simulation.reset([1], [np.random.default_rng(4)])
        tape = []
        for action in np.random.default_rng(5).uniform(-1, 1, (100, 2, 1)):
            tape.append(simulation.observe()[1])
            assert not simulation.step(action).any()
        return np.array(tape)

    first = episode()
    simulation.readings.qvel[1] = np.nan
    simulation.step(np.zeros((2, 1)))
    np.testing.assert_array_equal(first, episode())


def test_copied_data_are_the_lane_s():
    simulation = Simulation(get_task("move_to_pose"), 3, 1)
    simulation.reset(range(3), [np.random.default_rng(i) for i in range(3)])
    simulation.step(np.ones((3, 1)))
    data = simulation.copy_data(2)
    np.testing.assert_array_equal(data.qpos, simulation.readings.qpos[2])
    np.testing.assert_array_equal(data.body("jitterbug").xmat, simulation.readings.rotation[2])
    np.testing.assert_allclose(data.geom("target").xpos, simulation.readings.target_position[2])


def test_a_simulation_is_shown_on_one_line():
    assert repr(Simulation(get_task("move_to_pose"), 3, 1)) == "Simulation(move_to_pose, 3 lanes)"


@pytest.mark.parametrize(("lanes", "threads"), [(0, 1), (-1, None), (1, 0)])
def test_numbers_below_one_are_refused(lanes, threads):
    with pytest.raises(InputError, match="must be at least 1"):
        Simulation(get_task("face_direction"), lanes, threads)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("actions", [np.zeros(2), np.zeros((2, 2)), np.zeros((3, 1)), 0.5])
def test_actions_of_another_shape_are_refused(actions, size):
    with pytest.raises(InputError, match=rf"actions have shape .*: it must be \(2, {size}\)"):
        check_actions(actions, 2, size)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite_are_refused(value):
    with pytest.raises(NonFiniteActionError, match="actions are not finite"):
        check_actions(np.array([[0.0], [value]]), 2, 1)
