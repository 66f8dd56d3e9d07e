"""A tiny environment with two actions of unequal bounds, which can be told to misbehave."""

import itertools

import gymnasium
import numpy as np
from gymnasium import spaces

ID, SERVO = "Test/Cart-v0", "Test/Servo-v0"
LIMIT = 20
_drift = itertools.count()


class Cart(gymnasium.Env):
    """A point on a line, pushed by the sum of its actions; it falls off at 1.

    Args:
        fail_seed: of an episode that raises an error at its step 7.
        drifts: whether starts depend on how many there were in the process.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(np.float32([-0.4, -1]), np.float32([0.7, 4]))

    def __init__(self, fail_seed=-1, drifts=False):
        self.fail_seed, self.drifts = fail_seed, drifts

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.fails = 0, seed == self.fail_seed
        self.state = self.np_random.uniform(-0.5, 0.5, 2) + self.drifts * next(_drift) * 1e-3
        return self.state.astype(np.float32), {}

    def step(self, action):
        assert Cart.action_space.contains(action), action
        self.steps += 1
        if self.fails and self.steps == 7:
            raise RuntimeError("the motor\x1b[2J is broken" + "!" * 2000 + "\nand more")
        self.state = self.state + 0.05 * np.array([self.state[1], np.sum(action)])
        terminated = bool(abs(self.state[0]) > 1)
        return self.state.astype(np.float32), -abs(self.state[0]), terminated, False, {}


class Servo(Cart):
    """The cart, driven by pulse widths [us]."""

    action_space = spaces.Box(1000, 2000, (2,), np.float32)

    def step(self, action):
        low, high = Cart.action_space.low, Cart.action_space.high
        share = (action.astype(np.float64) - 1000) / 1000
        return super().step((low + share * (high - low)).astype(np.float32).clip(low, high))


gymnasium.register(SERVO, entry_point=Servo, max_episode_steps=LIMIT)
gymnasium.register(ID, entry_point=Cart, max_episode_steps=LIMIT)
