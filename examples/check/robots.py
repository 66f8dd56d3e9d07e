"""Two robots as many a lab has them, with raw angles, for `jbrep check robots:RawPendulum-v0`."""

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformObservation


def raw_pendulum(**options):
    """Pendulum-v1 with its angle in place of cosine and sine."""
    made = gymnasium.make("Pendulum-v1", disable_env_checker=True, **options)
    space = Box(np.float32([-np.pi, -8]), np.float32([np.pi, 8]))

    def seen(observation):
        cosine, sine, speed = observation
        return np.float32([np.arctan2(sine, cosine), speed])

    return TransformObservation(made.unwrapped, seen, space)


class RawCartPole(gymnasium.Env):
    """A pole on a cart, to be swung up; the angle jumps from pi to -pi, and rails end at 2.4 m."""

    observation_space = Box(-np.inf, np.inf, (4,))  # x [m], its speed, angle [rad], its speed
    action_space = Box(-1, 1)
    dt = 0.02

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.normal([0, 0, np.pi, 0], 0.03)
        return self.seen(), {}

    def seen(self):
        x, v, angle, turn = self.state
        return np.float32([x, v, (angle + np.pi) % (2 * np.pi) - np.pi, turn])

    def step(self, action):
        _, v, angle, turn = self.state
        sine, cosine = np.sin(angle), np.cos(angle)
        push = (10 * float(action[0]) + 0.05 * turn**2 * sine) / 1.1
        spin = (9.8 * sine - cosine * push) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
        force = push - 0.05 * spin * cosine / 1.1
        self.state = self.state + self.dt * np.array([v, force, turn, spin])
        reward = float(np.cos(self.state[2]) - 0.05 * self.state[0] ** 2)
        return self.seen(), reward, bool(abs(self.state[0]) > 2.4), False, {}


gymnasium.register("RawPendulum-v0", entry_point=raw_pendulum, max_episode_steps=200)
gymnasium.register("RawCartPole-v0", entry_point=RawCartPole, max_episode_steps=500)
