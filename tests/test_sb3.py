"""The stable-baselines3 environment: its contract, resets, encoders and mistakes."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from jbrep.envs import JitterbugVecEnv
from jbrep.envs.episodes import Episodes
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS


class Halves:
    """Sees each pair of features as their mean."""

    latent_size = 8

    def __call__(self, observation):
        return observation.reshape(len(observation), 8, 2).mean(axis=2)


def actions(steps, lanes):
    return np.random.default_rng(0).uniform(-1, 1, (steps, lanes, 1)).astype(np.float32)


@pytest.mark.parametrize("task", TASKS)
def test_spaces_and_types(task):
    environment = JitterbugVecEnv(task, 2)
    assert environment.observation_space == spaces.Box(-np.inf, np.inf, (TASKS[task].size,))
    assert environment.action_space == spaces.Box(-1, 1, (1,))
    observation = environment.reset()
    assert observation.dtype == np.float32
    observation, reward, done, infos = environment.step(np.zeros((2, 1)))
    assert observation.shape == (2, TASKS[task].size)
    assert (reward.dtype, reward.shape, done.dtype, infos) == (np.float32, (2,), bool, [{}, {}])


def test_it_resets_in_the_step_that_ends_the_episode():
    environment, plain = JitterbugVecEnv("face_direction", 2, seed=4), Episodes("face_direction", 2)
    task = TASKS["face_direction"]
    scaled = lambda o: task.scale(o).astype(np.float32)  # noqa: E731
    np.testing.assert_array_equal(environment.reset(), scaled(plain.reset([4, 5])))
    for step, action in enumerate(actions(1001, 2), start=1):
        observation, reward, done, infos = environment.step(action)
        expected = plain.step(action)
        np.testing.assert_array_equal(observation, scaled(expected.observation))
        np.testing.assert_array_equal(reward, expected.reward.astype(np.float32))
        assert done.all() == done.any() == (step == 1000)
        if step == 1000:
            for lane, info in enumerate(infos):
                assert info["TimeLimit.truncated"] is True
                assert info["non_finite"] is False
                final = scaled(expected.final_observation)[lane]
                np.testing.assert_array_equal(info["terminal_observation"], final)
                assert not np.array_equal(final, observation[lane])


def test_every_step_gives_fresh_arrays():
    environment = JitterbugVecEnv("move_to_pose", 2)
    kept = [environment.reset()]
    copies = [kept[0].copy()]
    for action in actions(5, 2):
        observation, reward, done, _ = environment.step(action)
        kept += [observation, reward, done]
        copies += [observation.copy(), reward.copy(), done.copy()]
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize(("lanes", "threads"), [(1, 1), (3, 1), (3, 2), (8, None)])
def test_lane_i_has_the_episodes_of_seed_plus_i(lanes, threads):
    def tape(environment, lane, drive):
        rows = [environment.reset()[lane]]
        for action in drive:
            observation, reward, _, _ = environment.step(
                np.repeat(action[None], environment.num_envs, 0)
            )
            rows.append(np.append(observation[lane], reward[lane]))
        return np.concatenate(rows)

    drive = actions(60, 1)[:, 0]
    alone = JitterbugVecEnv("move_in_direction", 1, seed=10 + lanes - 1, num_threads=1)
    among = JitterbugVecEnv("move_in_direction", lanes, seed=10, num_threads=threads)
    np.testing.assert_array_equal(tape(alone, 0, drive), tape(among, lanes - 1, drive))


def test_seeds_count_once_and_again_when_set():
    environment = JitterbugVecEnv("face_direction", 2, seed=1)
    first, second = environment.reset(), environment.reset()
    assert not np.array_equal(first, second)
    environment.seed(1)
    np.testing.assert_array_equal(environment.reset(), first)
    np.testing.assert_array_equal(environment.reset(), second)


def test_the_encoder_sees_observations_in_physical_units_also_terminal_ones():
    plain = JitterbugVecEnv("face_direction", 2)
    coded = JitterbugVecEnv("face_direction", 2, encoder=Halves())
    assert coded.observation_space.shape == (8,)

    def check(latent, scaled):
        expected = Halves()(TASKS["face_direction"].unscale(scaled.astype(float)))
        np.testing.assert_allclose(latent, expected, rtol=1e-5, atol=1e-4)

    check(coded.reset(), plain.reset())
    for action in actions(1000, 2):
        observation, _, _, infos = plain.step(action)
        latent, _, done, coded_infos = coded.step(action)
        check(latent, observation)
    assert done.all()
    for info, coded_info in zip(infos, coded_infos, strict=True):
        check(coded_info["terminal_observation"][None], info["terminal_observation"][None])


def test_a_lane_that_diverges_is_flagged_and_the_others_go_on():
    one, other = JitterbugVecEnv("face_direction", 3), JitterbugVecEnv("face_direction", 3)
    one.reset(), other.reset()
    drive = actions(20, 3)
    for action in drive[:10]:
        before = one.step(action)[0]
        other.step(action)
    one.episodes.simulation.readings.qvel[1] = np.nan
    for step, action in enumerate(drive[10:]):
        observation, reward, done, infos = one.step(action)
        expected = other.step(action)
        np.testing.assert_array_equal(observation[[0, 2]], expected[0][[0, 2]])
        assert done.tolist() == [False, step == 0, False]
        if done.any():
            assert infos[1]["non_finite"] is True
            assert reward[1] == 0
            np.testing.assert_array_equal(infos[1]["terminal_observation"], before[1])
        assert np.isfinite(observation).all()


def test_vec_monitor_counts_returns():
    environment = VecMonitor(JitterbugVecEnv("move_from_origin", 2))
    environment.reset()
    total = np.zeros(2)
    for action in actions(1000, 2):
        _, reward, _, infos = environment.step(action)
        total += reward
    for lane, info in enumerate(infos):
        assert info["episode"]["r"] == pytest.approx(total[lane], rel=1e-4)
        assert info["episode"]["l"] == 1000


def test_an_agent_learns_on_it():
    environment = VecNormalize(VecMonitor(JitterbugVecEnv("face_direction", 4, encoder=Halves())))
    agent = PPO("MlpPolicy", environment, n_steps=32, batch_size=32, device="cpu", seed=0)
    before = agent.policy.state_dict()["action_net.weight"].clone()
    agent.learn(128)
    assert not before.equal(agent.policy.state_dict()["action_net.weight"])


def test_attributes_are_shared_by_the_lanes():
    environment = JitterbugVecEnv("face_direction", 3)
    assert environment.get_attr("task", [0, 2]) == [TASKS["face_direction"]] * 2
    assert environment.get_attr("render_mode") == [None] * 3
    assert environment.env_is_wrapped(VecMonitor, 1) == [False]
    assert environment.env_method("has_attr", "task") == [True] * 3
    assert not environment.has_attr("fly")
    environment.set_attr("note", 1)
    assert environment.get_attr("note") == [1] * 3


def test_mistakes_are_named():
    with pytest.raises(InputError, match=r"unknown task 'fly': choose one of move_from_origin"):
        JitterbugVecEnv("fly", 1)
    with pytest.raises(InputError, match="the number of robots is 0: it must be at least 1"):
        JitterbugVecEnv("face_direction", 0)

    class Liar(Halves):
        latent_size = 7

    with pytest.raises(InputError, match=r"shape \(2, 8\) .* latent_size asks for \(2, 7\)"):
        JitterbugVecEnv("face_direction", 2, encoder=Liar())
    environment = JitterbugVecEnv("face_direction", 2)
    environment.reset()
    with pytest.raises(InputError, match=r"shape \(2,\)"):
        environment.step(np.zeros(2))
    with pytest.raises(InputError, match="not finite"):
        environment.step(np.full((2, 1), np.nan))
