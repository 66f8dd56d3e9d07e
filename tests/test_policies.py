"""Policies: bounds, streams of their own, constants as people write them."""

import numpy as np
import pytest
from command import jbrep

from jbrep.collecting.policies import (
    POLICIES,
    Constant,
    Heuristic,
    Mixture,
    OrnsteinUhlenbeck,
    Still,
    Uniform,
    generators,
    make_policy,
    parse_policy,
)
from jbrep.dataset import Dataset
from jbrep.dataset.schema import episode_part
from jbrep.envs import Environments, Feature, Task, describe
from jbrep.envs.recording import outcome
from jbrep.errors import InputError
from jbrep.jitterbug.heuristics import HEURISTICS
from jbrep.jitterbug.tasks import TASKS
from jbrep.play.sources import find_player
from jbrep.rl.policy_file import FOLDER, SHIPPED, shipped, shipped_file

TASK = describe("face_direction")
ARM = Task(
    id="Arm-v0",
    name="Arm-v0",
    features=(Feature("x"),),
    action_low=(-1.0, 0.0, -2.0),
    action_high=(1.0, 10.0, 0.5),
    max_episode_steps=50,
    timestep=0.1,
)


def drives(policy, envs=50, steps=1000, seed=0, task=TASK):
    act = policy.begin(task, range(seed, seed + envs))
    observation = np.zeros((envs, task.size))
    return np.stack([act(observation) for _ in range(steps)])


@pytest.mark.parametrize("policy", [kind() for kind in POLICIES.values()], ids=POLICIES)
def test_actions_are_drives_in_range_that_their_settings_make_again(policy):
    assert drives(policy).shape == (1000, 50, 1)
    assert np.abs(drives(policy)).max() <= 1
    again = make_policy(policy.settings())
    assert again == policy
    np.testing.assert_array_equal(drives(policy), drives(again))


def test_uniform_drives_fill_the_range_and_don_t_hang_together():
    actions = drives(Uniform())[..., 0]
    np.testing.assert_allclose(np.quantile(actions, (0.25, 0.5, 0.75)), (-0.5, 0, 0.5), atol=0.02)
    assert abs(np.corrcoef(actions[1:].ravel(), actions[:-1].ravel())[0, 1]) < 0.02


def test_ornstein_uhlenbeck_noise_has_the_spread_and_memory_of_its_constants():
    """After many time constants: sigma / sqrt(2 theta), correlation exp(-theta t)."""
    actions = drives(OrnsteinUhlenbeck(mu=0.2, theta=5, sigma=0.5), envs=200)[..., 0]
    assert (actions[0] == 0.2).all()  # its mean, where it starts
    actions = actions[200:]
    assert actions.mean() == pytest.approx(0.2, abs=0.01)
    assert actions.std() == pytest.approx(0.5 / np.sqrt(10), rel=0.03)
    now, later = actions[:-20].ravel(), actions[20:].ravel()  # 0.2 s on
    assert np.corrcoef(now, later)[0, 1] == pytest.approx(np.exp(-5 * 0.2), abs=0.03)


def test_episodes_have_streams_of_their_own():
    """What an episode's generator gives doesn't depend on those beside it."""
    both = drives(Uniform(), envs=2)
    np.testing.assert_array_equal(both[:, 1:], drives(Uniform(), envs=1, seed=1))


@pytest.mark.parametrize(
    ("text", "policy"),
    [
        ("uniform", Uniform()),
        ("heuristic", Heuristic()),
        ("constant:drive=-0.5", Constant(-0.5)),
        ("ornstein-uhlenbeck", OrnsteinUhlenbeck()),
        ("ornstein-uhlenbeck:sigma=1,theta=2", OrnsteinUhlenbeck(theta=2, sigma=1)),
        ("constant:drive=1e+0", Constant(1)),
        ("uniform:3+constant:drive=-0.5:1", Mixture(((0.75, Uniform()), (0.25, Constant(-0.5))))),
    ],
)
def test_policies_as_people_write_them(text, policy):
    assert parse_policy(text) == policy


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sprint", "unknown policy 'sprint': choose one of uniform, still, heuristic"),
        ("constant:speed=1", "unknown constant.speed: it must be one of drive"),
        ("uniform:low=0", "unknown uniform.low: there are none"),
        ("constant:drive=fast", "constant.drive is 'fast'"),
        ("constant:drive=2", "constant.drive is 2.0"),
        ("constant:drive=nan", "constant.drive is nan"),
        ("ornstein-uhlenbeck:theta=-1", "theta is -1.0"),
        ("uniform:0.5+heuristic", "weight 'heuristic' must be a positive number"),
        ("uniform:1e308+uniform:1e308", "weight '1e308' must be a positive number below 1e12"),
        ("uniform:0.5+sprint:0.5", "unknown policy 'sprint'"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(InputError, match=message):
        parse_policy(text)


@pytest.mark.parametrize("policy", [Uniform(), Constant(0.5), OrnsteinUhlenbeck(sigma=9)], ids=str)
def test_actions_of_several_numbers_keep_to_the_bounds_of_each(policy):
    actions = drives(policy, envs=20, steps=200, task=ARM)
    assert actions.shape == (200, 20, 3)
    low, high = np.array(ARM.action_low), np.array(ARM.action_high)
    assert (low <= actions).all()
    assert (actions <= high).all()
    if isinstance(policy, Constant):
        np.testing.assert_array_equal(actions[0, 0], [0.5, 7.5, -0.125])
    else:
        share = (actions.mean(axis=(0, 1)) - low) / (high - low)
        np.testing.assert_allclose(share, 0.5, atol=0.1)
        np.testing.assert_allclose(np.corrcoef(actions.reshape(-1, 3).T), np.eye(3), atol=0.15)


def test_standing_still_is_zero_or_what_is_next_to_it():
    pushed = ARM.replace(action_low=(0.5, 0.0, -2.0))
    for task, expected in ((ARM, [0, 0, 0]), (pushed, [0.5, 0, 0])):
        actions = drives(Still(), envs=2, steps=3, task=task)
        np.testing.assert_array_equal(actions, np.broadcast_to(expected, (3, 2, 3)))


def test_drives_are_not_rescaled_where_the_bounds_are_those_of_drives():
    """Scaling -1 + (x + 1) would change the last bits of most."""
    rough = OrnsteinUhlenbeck(theta=1, sigma=3)
    own = drives(rough, envs=2, task=ARM.replace(timestep=TASK.timestep))[:, :, :1]
    assert (own > -1).any()
    wide = ARM.replace(action_low=(-1.0,), action_high=(1.0,), timestep=TASK.timestep, draws=6)
    np.testing.assert_array_equal(drives(rough, envs=2, task=wide), drives(rough, envs=2))


def test_a_policy_draws_beyond_what_the_environment_draws():
    """The environment's generator has the same seed: its numbers must not come again as actions."""
    known = generators(TASK, [7])[0].uniform(size=50)
    whole = np.random.default_rng(7).uniform(size=56)
    np.testing.assert_array_equal(known, whole[6:])
    unknown = generators(ARM, [7])[0].uniform(size=1000)
    assert not np.isin(unknown, np.random.default_rng(7).uniform(size=100_000)).any()


def test_noise_needs_a_time_step_that_is_known_and_small_enough():
    noise = OrnsteinUhlenbeck(theta=101)
    with pytest.raises(InputError, match=r"theta is 101: with steps of 0.01 s .* in \[0, 100\]"):
        noise.begin(TASK, [0])
    with pytest.raises(InputError, match="the time step of Arm-v0 is not known: give it"):
        noise.begin(ARM.replace(timestep=None), [0])


MIXTURE = parse_policy("uniform:1+constant:drive=0.5:2+heuristic:1")


def test_each_episode_of_a_mixture_has_one_of_its_policies():
    """Each in its share of the episodes, drawn from the seed alone; its actions are its own."""
    actions = drives(MIXTURE, envs=400, steps=3)
    weights = [weight for weight, _ in MIXTURE.parts]
    drawn = np.array([episode_part(seed, weights) for seed in range(400)])
    np.testing.assert_allclose(np.bincount(drawn) / 400, weights, atol=0.06)
    alone = [drives(policy, envs=400, steps=3) for _, policy in MIXTURE.parts]
    for index, part in enumerate(drawn):
        np.testing.assert_array_equal(actions[:, index], alone[part][:, index])
    np.testing.assert_array_equal(drives(MIXTURE, envs=1, seed=7)[:3, 0], actions[:, 7])
    assert make_policy(MIXTURE.settings()) == MIXTURE


def test_what_chooses_an_episode_s_policy_is_drawn_from_nothing_else():
    """Not from the environment's numbers, nor from those that the policies draw."""
    ours = {np.random.default_rng([seed, 0x6D6978]).random() for seed in range(50)}
    for seed in range(50):
        others = np.random.default_rng(seed).random(1000)
        beyond = generators(ARM, [seed])[0].random(1000)
        assert ours.isdisjoint([*others, *beyond])


@pytest.mark.parametrize(("task", "least"), [*zip(TASKS, (950, 930, 640, 850, 500), strict=True)])
def test_median_return_of_four_episodes(task, least):
    played = outcome(Environments(describe(task), 4), HEURISTICS[task])
    assert np.median(played.returns) >= least


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


SHIPS = shipped()


def test_each_file_that_ships_is_listed_with_what_it_returns():
    assert {policy.task for policy in SHIPS} == {path.stem for path in FOLDER.glob("*.safetensors")}
    lines = jbrep("policies").output.splitlines()
    listed = [line.split()[0] for line in lines[1 : len(SHIPS) + 1]]
    assert listed == [policy.task for policy in SHIPS]


@pytest.mark.parametrize("policy", SHIPS, ids=lambda policy: policy.task)
def test_it_returns_what_the_table_says(policy):
    """Rounding parts long episodes, so that single returns differ between processors."""
    known = policy.returns[SHIPPED]
    played = find_player(SHIPPED, describe(policy.task)).returns(2)
    assert abs(played.mean() - known[:2].mean()) < 2 * known.std() + 20


def test_it_collects_and_is_kept_with_the_data(tmp_path):
    command = ("collect", "--task", "face_direction", "--steps", 300, "--episode-steps", 100)
    told = jbrep(*command, "--policy", "uniform:0.5+trained:0.5", "--out", tmp_path / "data")
    assert told.exit_code == 0, told.output
    (_, _), (_, kept) = Dataset(tmp_path / "data").manifest.settings.policy["parts"]
    assert kept["run"] == SHIPPED
    ships = shipped_file("face_direction").read_bytes()
    assert (tmp_path / "data" / kept["file"]).read_bytes() == ships
    assert jbrep("data", "verify", tmp_path / "data", "--replay", 3).exit_code == 0
