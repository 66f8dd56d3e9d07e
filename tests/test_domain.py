"""The contract that dm_control holds its own domains to, and equality with the batch."""

from unittest import mock

import numpy as np
import pytest
from dm_control import suite

from jbrep import jitterbug
from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import TASKS, get_task

jitterbug.register_with_suite()
pytestmark = pytest.mark.parametrize("task", TASKS)


def load(task, **kwargs):
    return suite.load("jitterbug", task, **kwargs)


def episodes(environment, seed=0, count=2, steps=1000):
    """Every time step of some episodes of random actions."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        step = environment.reset()
        yield step
        for _ in range(steps):
            step = environment.step(random.uniform(-1, 1, 1))
            yield step
            if step.last():
                break


def test_the_suite_knows_the_task_in_all_its_lists(task):
    jitterbug.register_with_suite()  # a second time changes nothing
    pair = ("jitterbug", task)
    level, other = (suite.EASY, suite.HARD)
    if TASKS[task].level == "hard":
        level, other = other, level
    for tasks in (suite.ALL_TASKS, suite.BENCHMARKING, suite.REWARD_VIZ, level):
        assert tasks.count(pair) == 1
    for tasks in (suite.EXTRA, suite.NO_REWARD_VIZ, other):
        assert pair not in tasks
    assert suite.TASKS_BY_DOMAIN["jitterbug"] == tuple(TASKS)
    assert len(suite.ALL_TASKS) == sum(map(len, suite.TASKS_BY_DOMAIN.values()))
    assert ("walker", "run") in suite.ALL_TASKS


def test_every_part_of_the_model_has_a_name(task):
    model = load(task).physics.model
    kinds = {
        "body": "nbody", "joint": "njnt", "geom": "ngeom", "site": "nsite", "camera": "ncam",
        "light": "nlight", "mesh": "nmesh", "hfield": "nhfield", "texture": "ntex",
        "material": "nmat", "equality": "neq", "tendon": "ntendon", "actuator": "nu",
        "sensor": "nsensor", "numeric": "nnumeric", "text": "ntext", "tuple": "ntuple",
    }  # fmt: skip
    for kind, size in kinds.items():
        assert all(model.id2name(i, kind) for i in range(getattr(model, size))), kind
    assert model.ncam >= 2


def test_time_steps_keep_to_the_specs(task):
    environment = load(task)
    action = environment.action_spec()
    assert (action.minimum, action.maximum) == (-1, 1)
    for step in episodes(environment, steps=50):
        spec = environment.observation_spec()
        assert set(step.observation) == set(spec)
        for name, value in step.observation.items():
            spec[name].validate(value)
            assert np.isfinite(value).all()
        if step.first():
            assert step.reward is None
            assert step.discount is None
        else:
            assert isinstance(step.reward, float)
            assert 0 <= step.reward <= 1
            assert step.discount == 1.0


def test_an_episode_ends_by_time_alone_after_1000_steps(task):
    environment = load(task)
    with mock.patch.object(environment.physics, "step"):  # the limit counts steps
        steps = list(episodes(environment, count=1, steps=2000))
    assert len(steps) == 1001
    assert steps[-1].last()
    assert steps[-1].discount == 1.0


def test_no_feature_is_constant(task):
    some = episodes(load(task), count=2, steps=60)
    steps = [np.concatenate(list(step.observation.values())) for step in some]
    assert (np.ptp(steps, axis=0) > 0).all()


def test_observations_share_no_memory(task):
    environment = load(task)
    one = environment.reset().observation
    other = environment.step(np.zeros(1)).observation
    arrays = [*one.values(), *other.values()]
    for i, array in enumerate(arrays):
        assert not any(np.may_share_memory(array, b) for b in arrays[i + 1 :])


def test_every_environment_has_the_same_episode_bit_for_bit(task):
    """A plain dm_control environment and an environment among others, over two episodes."""
    environment = jitterbug.load(task, seed=5, time_limit=1)
    envs = Simulation(get_task(task), 3, 2)
    randoms = [np.random.default_rng(seed) for seed in (4, 5, 6)]
    actions = np.random.default_rng(0)
    for _ in range(2):
        step = environment.reset()
        envs.reset(range(3), randoms)
        while True:
            flat = np.concatenate(list(step.observation.values()))
            np.testing.assert_array_equal(flat, envs.observe()[1])
            if step.last():
                break
            action = actions.uniform(-1, 1, (3, 1))
            step = environment.step(action[1])
            envs.step(action)
            assert step.reward == envs.reward()[1]
