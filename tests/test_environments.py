"""Environments over any environment: resets, ends, snapshots, and environments that fail."""

import environments  # noqa: F401 - it registers the sledges
import gymnasium
import numpy as np
import pytest

from jbrep.envs import Environments, describe
from jbrep.envs.environments import EnvironmentFailedError, NonFiniteActionError
from jbrep.envs.recording import open_loop, play, read_states, record
from jbrep.errors import InputError

TASKS = {
    name: describe(name, episode_steps=30)
    for name in ("face_direction", "Pendulum-v1", "Hopper-v5", "Sledges/Told-v0")
}
SLEDGE = describe("Sledges/Sledge-v0")
BROKEN = {"raises": "RuntimeError: the rail broke$", "size": "an observation of 3 numbers instead"}
NOT_FINITE = "gave an observation or reward that is not finite in 32 bits, at step 4 of the episode"
each_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


def actions_of(task, seeds, steps):
    """Actions (T, n, k), each environment's from its own seed."""
    shape = (steps, task.action_size)
    drawn = [
        np.random.default_rng([seed, 1]).uniform(task.action_low, task.action_high, shape)
        for seed in seeds
    ]
    return np.stack(drawn, axis=1).astype(np.float32)


def played(task, seeds, envs=None, steps=40):
    """What so many environments go through with these seeds."""
    envs = envs or Environments(task, len(seeds), 1)
    envs.reset(range(len(seeds)), seeds)
    return record(envs, open_loop(actions_of(task, seeds, steps)), lambda made: None, read_states)


def assert_same_episode(one, i, other, j):
    """Equal up to the end of the episode, bit for bit."""
    length = one.length[i]
    assert (length, one.terminated[i], one.truncated[i]) == (
        *(other.length[j], other.terminated[j]),
        other.truncated[j],
    )
    for name in ("observation", "reward"):
        steps = length + (name == "observation")
        mine, theirs = getattr(one, name)[:steps, i], getattr(other, name)[:steps, j]
        np.testing.assert_array_equal(mine, theirs)
    for name, values in one.arrays.items():
        np.testing.assert_array_equal(values[: length + 1, i], other.arrays[name][: length + 1, j])
    for name, values in one.start.items():
        np.testing.assert_array_equal(values[i], other.start[name][j])


@each_task
def test_a_environment_s_episode_depends_on_its_seed_and_actions_alone(task):
    """Neither on the environments beside it, nor on the episodes before it."""
    many = played(task, [5, 6, 7, 8])
    for index, seed in enumerate([5, 6, 7, 8]):
        assert_same_episode(many, index, played(task, [seed]), 0)
    used = Environments(task, 2, 1)
    played(task, [1, 2], used)
    assert_same_episode(many, 2, played(task, [9, 7], used), 1)


@each_task
def test_a_environment_is_the_environment_that_gymnasium_makes(task):
    recording = played(task, [3])
    environment = gymnasium.make(task.id, max_episode_steps=30)
    observation, _ = environment.reset(seed=3)
    actions = actions_of(task, [3], 40)[:, 0]
    for step in range(recording.length[0]):
        np.testing.assert_array_equal(recording.observation[step, 0], np.float32(observation))
        observation, reward, terminated, truncated, _ = environment.step(actions[step])
        assert recording.reward[step, 0] == np.float32(reward)
    assert (terminated, truncated) == (recording.terminated[0], recording.truncated[0])


@each_task
def test_chosen_environments_are_reset_and_the_others_go_on(task):
    envs, undisturbed = Environments(task, 3, 1), Environments(task, 3, 1)
    for each in (envs, undisturbed):
        each.reset([0, 1, 2], [4, 5, 6])
    actions = actions_of(task, [4, 5, 6], 8)
    for step, action in enumerate(actions):
        if step == 4:
            observation = envs.reset([1], [9])
            np.testing.assert_array_equal(observation[[0, 2]], undisturbed.observation[[0, 2]])
            assert (observation[1] != undisturbed.observation[1]).any()
        new, old = envs.step(action), undisturbed.step(action)
        for one, other in zip(new[:4], old[:4], strict=True):
            np.testing.assert_array_equal(one[[0, 2]], other[[0, 2]])
    alone = Environments(task, 1, 1)
    alone.reset([0], [9])
    for action in actions[4:]:
        alone.step(action[1:2])
    np.testing.assert_array_equal(alone.observation[0], envs.observation[1])


def test_terminated_and_truncated_are_told_apart():
    hopper, pendulum = played(TASKS["Hopper-v5"], range(6)), played(TASKS["Pendulum-v1"], [1, 2])
    early = hopper.length < 30
    assert early.any()
    np.testing.assert_array_equal(hopper.terminated[early], True)
    np.testing.assert_array_equal(hopper.truncated[early], False)
    np.testing.assert_array_equal(pendulum.length, 30)
    assert not pendulum.terminated.any()
    assert pendulum.truncated.all()
    both = played(describe("Sledges/Exact-v0"), [1])
    assert (both.length[0], both.terminated[0], both.truncated[0]) == (7, True, True)


def test_a_environment_that_has_ended_stands_still():
    envs = Environments(SLEDGE, 4)
    seeds = [0, 1, 2, 3]
    envs.reset(range(4), seeds)
    last, ended_at = envs.observation.copy(), {}
    for step, each in enumerate(play(envs, open_loop(actions_of(SLEDGE, seeds, 40)))):
        before = ~each.active
        np.testing.assert_array_equal(each.step.observation[before], last[before])
        assert not each.step.reward[before].any()
        np.testing.assert_array_equal(each.step.terminated[before], True)
        assert envs.num_active == envs.active.sum()
        for index in np.flatnonzero(~envs.active):
            ended_at.setdefault(index, step)
        last = each.step.observation.copy()
    assert len(set(ended_at.values())) > 1
    np.testing.assert_array_equal(envs.reset([0], [0])[1:], last[1:])
    assert envs.active.tolist() == [True, False, False, False]


@pytest.mark.parametrize("how", ["raises", "size", "nan", "huge", "reward"])
def test_an_environment_that_fails_is_named_with_its_seed_and_step(how):
    task = describe("Sledges/Broken-v0", {"how": how, "seed": 12})
    envs = Environments(task, 3)
    envs.reset(range(3), [11, 12, 13])
    actions = actions_of(task, [11, 12, 13], 4)
    for action in actions[:3]:
        envs.step(action)
    with pytest.raises(EnvironmentFailedError, match=BROKEN.get(how, NOT_FINITE)) as failure:
        envs.step(actions[3])
    assert "at step 4 of the episode with seed 12" in str(failure.value)


def test_actions_have_as_many_numbers_as_the_task_s():
    envs = Environments(SLEDGE, 2)
    envs.reset([0, 1], [0, 1])
    with pytest.raises(InputError, match=r"\(2, 3\)"):
        envs.step(np.zeros((3, 3)))
    with pytest.raises(NonFiniteActionError):
        envs.step(np.full((2, 3), np.nan))
    with pytest.raises(InputError, match="the number of environments is 0"):
        Environments(SLEDGE, 0)


def test_actions_are_stepped_as_they_are_stored():
    """In 32 bits, within bounds that have 64."""
    task = describe("Sledges/Exact-v0")
    envs = Environments(task, 2)
    envs.reset([0, 1], [0, 1])
    for action in ([task.action_low, task.action_high], [[0.2], [0.29]]):
        observation = envs.step(np.array(action)).observation
        np.testing.assert_array_equal(observation[:, 0], np.float32(action)[:, 0])
        np.testing.assert_array_equal(observation[:, 1], 0)
