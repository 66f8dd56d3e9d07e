"""Environments are independent, bit for bit, whatever their number and that of the threads."""

import mujoco
import numpy as np
import pytest

from jbrep.jitterbug.bodies import draw
from jbrep.jitterbug.simulation import PHYSICS_STEPS, Simulation, plain_model
from jbrep.jitterbug.tasks import get_task


def rollout(seeds, num_threads, spoil=None):
    """Observations, rewards and divergence of each seed's environment, (T, n, ...)."""
    simulation = Simulation(get_task("move_to_pose"), len(seeds), num_threads)
    simulation.reset(range(len(seeds)), [np.random.default_rng(seed) for seed in seeds])
    actions = np.stack(
        [np.random.default_rng([seed, 1]).uniform(-1, 1, (150, 1)) for seed in seeds], 1
    )
    tape = []
    for step, action in enumerate(actions):
        if spoil and step == 100:
            spoil(simulation)
        diverged = simulation.step(action)
        tape.append((simulation.observe(), simulation.reward(), diverged))
    return tuple(np.array(column) for column in zip(*tape, strict=True))


@pytest.mark.parametrize("value", [np.nan, 1e12])
def test_a_environment_that_diverges_says_so_and_leaves_the_others_alone(value):
    def spoil(simulation):
        simulation.readings.qvel[1, 4] = value

    whole, spoilt = rollout(range(3), 2), rollout(range(3), 2, spoil=spoil)
    for one, other in zip(whole, spoilt, strict=True):
        np.testing.assert_array_equal(one[:, [0, 2]], other[:, [0, 2]])
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


def drive(simulation, steps=60):
    """Observations under the same drive in all environments, (T, n, d)."""
    tape = []
    for step in range(steps):
        simulation.step(np.full((simulation.num_envs, 1), 0.8 * np.sin(0.3 * step)))
        tape.append(simulation.observe())
    return np.array(tape)


def with_bodies(seeds, body, **more):
    """A simulation at the start of each seed's episode."""
    simulation = Simulation(get_task("move_to_pose"), len(seeds), 2, body, **more)
    simulation.reset(range(len(seeds)), [np.random.default_rng(seed) for seed in seeds])
    return simulation


def assert_moves_like(simulation, models):
    """Each environment moves bit for bit like a single simulation of its model."""
    start, tape = simulation.state, []
    drive(simulation)
    for index, model in enumerate(models):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start["qpos"][index], start["qvel"][index]
        for step in range(60):
            data.ctrl[0] = 0.8 * np.sin(0.3 * step)
            mujoco.mj_step(model, data, nstep=PHYSICS_STEPS)
        tape.append(np.concatenate([data.qpos, data.qvel]))
    now = simulation.readings
    np.testing.assert_array_equal(np.hstack([now.qpos, now.qvel]), tape)


def test_a_environment_moves_like_a_single_simulation_of_its_body():
    simulation = with_bodies(range(3), "random", materials=True)
    numbers = simulation.state["body"].astype(int)
    assert_moves_like(simulation, [plain_model(draw(n, materials=True)) for n in numbers])


def test_a_environment_s_model_has_its_friction_and_mass():
    simulation, factors = with_bodies(range(3), 7), np.array([(1, 1), (1, 2), (0.2, 0.5)])
    simulation.reset(range(3), [np.random.default_rng(4)] * 3, factors=factors)
    models, usual = [simulation.model_of(index) for index in range(3)], plain_model(draw(7))
    for model, (friction, mass) in zip(models, factors, strict=True):
        np.testing.assert_allclose(model.geom_friction, friction * usual.geom_friction)
        np.testing.assert_allclose(model.body_subtreemass, mass * usual.body_subtreemass)
    assert_moves_like(simulation, models)


def test_a_random_body_is_the_episode_s_whatever_its_environment():
    whole = with_bodies(range(6), "random")
    numbers, tape = whole.state["body"], drive(whole)
    assert len(set(numbers)) == 6
    alone, moved = with_bodies([4], "random"), with_bodies([9, 4, 0], "random")
    for simulation, index in ((alone, 0), (moved, 1)):
        assert simulation.state["body"][index] == numbers[4]
        np.testing.assert_array_equal(drive(simulation)[:, index], tape[:, 4])


def test_a_random_body_changes_nothing_else_that_is_drawn():
    plain, other = np.random.default_rng(3), np.random.default_rng(3)
    one = Simulation(get_task("move_to_pose"), 1, 1)
    two = Simulation(get_task("move_to_pose"), 1, 1, "random")
    for _ in range(2):
        one.reset([0], [plain])
        two.reset([0], [other])
        for name in ("target_position", "target_quaternion"):
            np.testing.assert_array_equal(one.state[name], two.state[name])
        np.testing.assert_array_equal(one.state["qpos"][:, 3:], two.state["qpos"][:, 3:])
        assert plain.bit_generator.state == other.bit_generator.state


@pytest.mark.parametrize("body", [None, 7, "random"])
def test_a_restored_simulation_continues_with_its_bodies(body):
    one = with_bodies(range(3), body)
    drive(one, 20)
    one.reset([1], [np.random.default_rng(9)])
    drive(one, 20)
    other = with_bodies([5, 6, 7], body)
    other.restore(**one.state)
    for name, values in one.state.items():
        np.testing.assert_array_equal(other.state[name], values)
        assert values.shape[0] == 3
        assert values.dtype == np.float64
    np.testing.assert_array_equal(drive(one), drive(other))


def test_a_environment_s_model_and_data_are_those_of_its_body():
    simulation = with_bodies(range(2), "random")
    simulation.step(np.ones((2, 1)))
    for index, number in enumerate(simulation.state["body"].astype(int)):
        model = simulation.model_of(index)
        assert model is simulation.model_of(index)
        assert model.ntexdata > 1000  # to be rendered with
        own, data = plain_model(draw(number)), simulation.copy_data(index)
        expected = mujoco.MjData(own)
        expected.qpos[:] = simulation.readings.qpos[index]
        mujoco.mj_kinematics(own, expected)
        target = simulation.readings.target_position[index]
        np.testing.assert_allclose(data.geom("target").xpos, target)
        for robot in (data, expected):
            robot.geom("target").xpos[:] = robot.geom("target_pointer").xpos[:] = 0
        np.testing.assert_array_equal(model.geom_size, own.geom_size)
        np.testing.assert_array_equal(data.geom_xpos, expected.geom_xpos)
    before = simulation.model_of(0)
    simulation.reset([0], [np.random.default_rng(50)])
    assert simulation.model_of(0) is not before
