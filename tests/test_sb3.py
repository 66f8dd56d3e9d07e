"""The stable-baselines3 environment: its contract, seeds, resets, encoders and mistakes."""

import itertools

import cart
import numpy as np
import pytest
from gymnasium import spaces

from jbrep import JitterbugVecEnv
from jbrep.encoders import find
from jbrep.envs import Environments, describe
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS

FACE = describe("face_direction", episode_steps=100)
CART = describe(cart.ID)
MANY = (FACE, CART, describe("Pendulum-v1", episode_steps=30), describe("Hopper-v5"))
each_task = pytest.mark.parametrize("task", MANY, ids=lambda task: task.name)


def actions(steps, envs, task=FACE):
    drawn = np.random.default_rng(0).uniform(-1, 1, (steps, envs, task.action_size))
    return drawn.astype(np.float32)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_and_types(task):
    environment = JitterbugVecEnv(task, 2)
    assert environment.observation_space == spaces.Box(-np.inf, np.inf, (TASKS[task].plain.size,))
    assert environment.action_space == spaces.Box(-1, 1, (1,))
    observation = environment.reset()
    assert observation.dtype == np.float32
    observation, reward, done, infos = environment.step(np.zeros((2, 1)))
    assert observation.shape == (2, TASKS[task].plain.size)
    assert (reward.dtype, reward.shape, done.dtype, infos) == (np.float32, (2,), bool, [{}, {}])


@each_task
def test_it_resets_in_the_step_that_ends_the_episode(task):
    """Each goes through the episodes of its seeds, as environments do that are reset by hand."""
    environment, envs = JitterbugVecEnv(task, 3, seed=4), Environments(task, 3)
    scaled = lambda observation: task.scale(observation).astype(np.float32)  # noqa: E731
    np.testing.assert_array_equal(environment.reset(), scaled(envs.reset(range(3), [4, 5, 6])))
    ends, counters = set(), [itertools.count(1) for _ in range(3)]
    for action in actions(150, 3, task):
        observation, reward, done, infos = environment.step(action)
        expected = envs.step(task.unscale_action(action))
        np.testing.assert_array_equal(reward, expected.reward.astype(np.float32))
        np.testing.assert_array_equal(done, expected.terminated | expected.truncated)
        for index in np.flatnonzero(done):
            info, terminated = infos[index], bool(expected.terminated[index])
            ends.add(terminated)
            assert info["TimeLimit.truncated"] is not terminated
            assert info.get("non_finite") is (False if task is FACE else None)
            final = scaled(expected.observation)[index]
            np.testing.assert_array_equal(info["terminal_observation"], final)
            assert not np.array_equal(final, observation[index])
            words = np.random.SeedSequence([4 + index, next(counters[index])]).generate_state(1)
            envs.reset([index], [int(words[0]) >> 1])
        assert not any(infos[index] for index in np.flatnonzero(~done))
        np.testing.assert_array_equal(observation, scaled(envs.observation))
    assert ends == {cart.ID: {True, False}, "Hopper-v5": {True}}.get(task.name, {False})


@each_task
def test_the_middle_of_an_episode_is_restored_to_the_same_bits(task):
    one, other = JitterbugVecEnv(task, 3, seed=1), JitterbugVecEnv(task, 3, seed=7)
    one.reset()
    drive = actions(200, 3, task)
    for action in drive[:70]:
        one.step(action)
    state = one.state
    expected = [one.step(action)[:3] for action in drive[70:]]  # past the ends of episodes
    for _ in range(2):
        other.restore(state)
        for action, step in zip(drive[70:], expected, strict=True):
            for ours, theirs in zip(other.step(action)[:3], step, strict=True):
                np.testing.assert_array_equal(ours, theirs)


def test_the_environment_gets_actions_within_its_bounds():
    """Scaled to them from [-1, 1] they could round to beyond; the cart refuses those."""
    environment = JitterbugVecEnv(CART, 1)
    environment.reset()
    for scaled_action in (np.ones((1, 2), np.float32), np.full((1, 2), -1e9)):
        environment.step(scaled_action)
    np.testing.assert_array_equal(CART.unscale_action(np.ones(2)), CART.action_high)
    np.testing.assert_array_equal(
        CART.unscale_action(np.zeros(2)), np.mean((CART.action_low, CART.action_high), 0)
    )
    drawn = np.random.default_rng(0).uniform(-1, 1, (9, 1)).astype(np.float32)
    np.testing.assert_array_equal(FACE.unscale_action(drawn), drawn)  # no bit is lost


class Liar:
    """Says that it gives 7 numbers, and gives 8."""

    latent_size = 7

    def __call__(self, observation):
        return observation[:, :8]


@pytest.mark.parametrize(
    ("task", "how", "named"),
    [
        ("face_direction", {"num_envs": 0}, "at least 1"),
        (FACE, {"num_envs": 1, "max_episode_steps": 7}, "time limit"),
        (CART, {"num_envs": 1, "encoder": find("dae-8", FACE)}, "made for face_direction"),
        (FACE, {"num_envs": 2, "encoder": Liar()}, "latent_size is 7"),
    ],
)
def test_mistakes_are_named(task, how, named):
    with pytest.raises(InputError, match=named):
        JitterbugVecEnv(task, **how)
