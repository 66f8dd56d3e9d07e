import numpy as np
import pytest

from jbrep.collect.policies import (
    POLICIES,
    Constant,
    Heuristic,
    OrnsteinUhlenbeck,
    Uniform,
    make_policy,
    parse_policy,
    policy_settings,
)
from jbrep.errors import InputError
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import TASKS

TASK = TASKS["face_direction"]


def drives(policy, lanes=50, steps=1000, seed=0):
    act = policy.begin(TASK, [np.random.default_rng(seed + lane) for lane in range(lanes)])
    observation = np.zeros((lanes, TASK.size))
    return np.stack([act(observation) for _ in range(steps)])


@pytest.mark.parametrize("policy", [kind() for kind in POLICIES.values()], ids=POLICIES)
def test_actions_are_drives_in_range_that_their_settings_make_again(policy):
    assert drives(policy).shape == (1000, 50, 1)
    assert np.abs(drives(policy)).max() <= 1
    again = make_policy(policy_settings(policy))
    assert again == policy
    np.testing.assert_array_equal(drives(policy), drives(again))


def test_uniform_drives_fill_the_range_and_don_t_hang_together():
    actions = drives(Uniform())[..., 0]
    np.testing.assert_allclose(np.quantile(actions, (0.25, 0.5, 0.75)), (-0.5, 0, 0.5), atol=0.02)
    assert abs(np.corrcoef(actions[1:].ravel(), actions[:-1].ravel())[0, 1]) < 0.02


def test_ornstein_uhlenbeck_noise_has_the_spread_and_memory_of_its_constants():
    """After many time constants: sigma / sqrt(2 theta), correlation exp(-theta t)."""
    actions = drives(OrnsteinUhlenbeck(mu=0.2, theta=5, sigma=0.5), lanes=200)[200:, :, 0]
    assert actions.mean() == pytest.approx(0.2, abs=0.01)
    assert actions.std() == pytest.approx(0.5 / np.sqrt(10), rel=0.03)
    now, later = actions[:-20].ravel(), actions[20:].ravel()  # 0.2 s on
    assert np.corrcoef(now, later)[0, 1] == pytest.approx(np.exp(-5 * 0.2), abs=0.03)


def test_ornstein_uhlenbeck_noise_starts_at_its_mean():
    np.testing.assert_array_equal(drives(OrnsteinUhlenbeck(mu=-0.4))[0], -0.4)


def test_a_constant_drive_and_the_hand_written_policy():
    assert np.unique(drives(Constant(-0.3))) == -0.3
    assert Heuristic().begin(TASK, []) is HEURISTICS["face_direction"]


def test_episodes_have_streams_of_their_own():
    """What an episode's generator gives doesn't depend on those beside it."""
    both = drives(Uniform(), lanes=2)
    np.testing.assert_array_equal(both[:, 1:], drives(Uniform(), lanes=1, seed=1))


@pytest.mark.parametrize(
    ("text", "policy"),
    [
        ("uniform", Uniform()),
        ("heuristic", Heuristic()),
        ("constant:drive=-0.5", Constant(-0.5)),
        ("ornstein-uhlenbeck", OrnsteinUhlenbeck()),
        ("ornstein-uhlenbeck:sigma=1,theta=2", OrnsteinUhlenbeck(theta=2, sigma=1)),
    ],
)
def test_policies_as_people_write_them(text, policy):
    assert parse_policy(text) == policy


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sprint", "unknown policy 'sprint': choose one of uniform, heuristic"),
        ("constant:speed=1", "no constant 'speed': it has drive"),
        ("uniform:low=0", "no constant 'low': it has none"),
        ("constant:kind=heuristic", "no constant 'kind'"),
        ("constant:drive", "drive is '', but must be a number"),
        ("constant:drive=fast", "drive is 'fast', but must be a number"),
        ("constant:drive=2", r"must be in \[-1, 1\]"),
        ("constant:drive=nan", r"must be in \[-1, 1\]"),
        ("ornstein-uhlenbeck:theta=101", r"theta in \[0, 100\]"),
        ("ornstein-uhlenbeck:sigma=1e15", r"sigma in \[0, 1e\+06\]"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(InputError, match=message):
        parse_policy(text)
