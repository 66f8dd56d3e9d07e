"""stable-baselines3's zip files from elsewhere: each plays as it was trained to see and act."""

import json
import shutil

import gymnasium
import numpy as np
from command import jbrep, mistake
from gymnasium import spaces
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from jbrep.encoders import save
from jbrep.encoders.shipped import unscaled
from jbrep.envs import describe
from jbrep.rl import Run, train
from jbrep.rl.files import EVALUATION_SEED, POLICY_ZIP, last_returns, read_evaluations

LIMIT = 20
PENDULUM = describe("Pendulum-v1", episode_steps=LIMIT)


class Far(gymnasium.ObservationWrapper):
    """Observations far from 0."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,))

    def observation(self, observation):
        return (observation * [100, 100, 1000] + [5000, -300, 0]).astype(np.float32)


class Driven(gymnasium.ActionWrapper):
    """Torques given by numbers in another range."""

    def __init__(self, env, low, high):
        super().__init__(env)
        self.action_space = spaces.Box(low, high, (1,))

    def action(self, action):
        low, high = self.action_space.low, self.action_space.high
        return (action - low) / (high - low) * 4 - 2


def make():
    pendulum = gymnasium.make("Pendulum-v1", max_episode_steps=LIMIT).unwrapped
    return Driven(Far(pendulum), 0, 10)


FAR = "Test/Far-v0"
gymnasium.register(FAR, entry_point=make, max_episode_steps=LIMIT)


def saved(path, kind=PPO, normalizes=True, **arguments):
    """An agent that saw some steps of the task, its statistics beside it, and what it returns."""
    env = DummyVecEnv([lambda: gymnasium.make(FAR)])
    if normalizes:
        env = VecNormalize(env, clip_obs=1.5)
    agent = kind(
        "MlpPolicy", env, seed=3, device="cpu", policy_kwargs={"net_arch": [16]}, **arguments
    )
    if kind is PPO:
        agent.policy.action_net.weight.data *= 300  # which begin near 0
    env.seed(0), env.reset()
    for number in range(40):
        env.step(np.full((1, 1), np.sin(number)))
    agent.save(path)
    if normalizes:
        env.save(path.with_name("vecnormalize.pkl"))
    one, returns = gymnasium.make(FAR), []
    for episode in range(3):
        observation, _ = one.reset(seed=EVALUATION_SEED + episode)
        total, ended = 0.0, False
        while not ended:
            seen = env.normalize_obs(observation) if normalizes else observation
            action, _ = agent.predict(seen, deterministic=True)
            observation, reward, terminated, truncated, _ = one.step(action)
            total, ended = total + reward, terminated or truncated
        returns.append(total)
    return returns


def played(path, task, *options, algorithm="ppo"):
    told = jbrep(
        *("evaluate-policy", path, "--trust", "--task", task, "--algorithm", algorithm),
        *("--episodes", 3, "--json", *options),
    )
    assert told.exit_code == 0, told.output
    return np.array(json.loads(told.stdout)["returns"]), told.stderr


def test_an_agent_sees_by_the_statistics_that_it_was_trained_with(tmp_path):
    path, statistics = tmp_path / "agent.zip", tmp_path / "vecnormalize.pkl"
    expected = saved(path, n_steps=8, batch_size=8)
    returns, said = played(path, FAR, "--vecnormalize", statistics)
    np.testing.assert_allclose(returns, expected, rtol=1e-4)
    assert said == ""
    returns, said = played(path, FAR)
    assert not np.allclose(returns, expected, rtol=1e-2)
    assert said.startswith(f"note: {path} doesn't say what its agent was trained to see")
    assert f"--vecnormalize {statistics}" in said
    assert said.count("\n") == 1


def test_a_zip_file_has_its_own_spaces_and_sees_what_the_environment_gives(tmp_path):
    path = tmp_path / "agent.zip"
    expected = saved(path, DDPG, normalizes=False, buffer_size=50)
    returns, said = played(path, FAR, algorithm="ddpg")
    np.testing.assert_allclose(returns, expected, rtol=1e-4)
    assert said.startswith("note: ")
    scaled, _ = played(path, FAR, "--encoder", "full", algorithm="ddpg")
    assert scaled.tolist() == returns.tolist()  # nothing is known by which to scale


def test_what_jbrep_wrote_tells_what_it_sees_and_how_it_acts(tmp_path):
    """Its observations are scaled, its actions scaled to [-1, 1] and held."""
    run = Run.of(
        PENDULUM,
        algorithm="a2c",
        overrides={"normalize": True, "action_repeat": 2, "net_arch": [8]},
        steps=64,
        evaluation_episodes=3,
        final_episodes=3,
    )
    assert train(run, tmp_path / "run").status == "finished"
    path = shutil.copy(tmp_path / "run" / POLICY_ZIP, tmp_path / "moved.zip")
    returns, said = played(path, "Pendulum-v1", "--episode-steps", LIMIT, algorithm="a2c")
    alone = jbrep("evaluate-policy", path, "--trust", "--algorithm", "a2c", "--episodes", 3)
    assert "Pendulum-v1 on full: median return" in alone.stdout
    np.testing.assert_allclose(returns, last_returns(read_evaluations(tmp_path / "run")), atol=1e-2)
    assert said == ""
    given = ("evaluate-policy", path, "--trust", "--task", "Pendulum-v1", "--algorithm", "a2c")
    refused = mistake(*given, "--vecnormalize", tmp_path / "any.pkl")
    assert "has the statistics that it needs: leave out --vecnormalize" in refused
    save(unscaled(PENDULUM), tmp_path / "other.safetensors")
    refused = mistake(*given, "--encoder", tmp_path / "other.safetensors")
    assert "was trained on full, which isn't this observation: give that" in refused


def test_what_does_not_fit_is_named_in_one_line(tmp_path):
    path, statistics = tmp_path / "agent.zip", tmp_path / "vecnormalize.pkl"
    saved(path, n_steps=8, batch_size=8)
    given = ("evaluate-policy", path, "--algorithm", "ppo", "--trust", "--task")
    assert "observes 3 numbers, where Hopper-v5 has 11" in mistake(*given, "Hopper-v5")
    assert "VecNormalize.save" in mistake(*given, FAR, "--vecnormalize", __file__)
    other = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Hopper-v5")]))
    other.save(statistics)
    assert "other observations" in mistake(*given, FAR, "--vecnormalize", statistics)
    assert "--trust" in mistake("evaluate-policy", path, "--vecnormalize", statistics)
    by_name = ("evaluate-policy", "uniform", "--vecnormalize", statistics)
    assert "--vecnormalize" in mistake(*by_name)
    assert "--trust" in mistake(*by_name[:2], "--trust")
    PPO("MlpPolicy", Driven(gymnasium.make("Pendulum-v1"), 1000, 2000), device="cpu").save(path)
    assert "its bounds must be these, or -1 to 1" in mistake(*given, "Pendulum-v1")
    assert "isn't a sac policy" in mistake(*given[:2], "--trust", "--task", "Pendulum-v1")
