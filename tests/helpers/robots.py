"""A module that registers an environment, as another package would."""

import gymnasium

ID = "Robots/Pendulum-v1"
gymnasium.register(ID, "gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=200)
