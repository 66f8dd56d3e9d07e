"""dm_control's reacher as a lab has its arm: joint positions, and places in the world."""

import gymnasium
import numpy as np
from dm_control import suite
from gymnasium.spaces import Box


class RawReacher(gymnasium.Env):
    """dm_control's reacher, its observation undone: joints, of which one winds, and places."""

    observation_space = Box(-np.inf, np.inf, (8,))  # joints, finger, target, speeds of joints
    action_space = Box(-1, 1, (2,))
    dt = 0.02

    def __init__(self):
        env = suite.load("reacher", "easy")
        self.physics, self.task = env.physics, env.task
        self.finger, self.target = (
            self.physics.model.name2id(each, "geom") for each in ("finger", "target")
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.task.random.seed(int(self.np_random.integers(2**32)))
        self.base = np.zeros(2)
        with self.physics.reset_context():
            self.task.initialize_episode(self.physics)
        return self.seen(), {}

    def seen(self):
        data = self.physics.data
        places = data.geom_xpos[[self.finger, self.target], :2] + self.base
        return np.concatenate([data.qpos, *places, data.qvel], dtype=np.float32)

    def step(self, action):
        self.physics.set_control(np.clip(action, -1, 1))
        self.physics.step()
        return self.seen(), float(self.task.get_reward(self.physics)), False, False, {}

    def quarter_turn(self, shift):
        """Turn the world about its vertical, then shift it; where the base stands isn't seen."""
        x, y, _ = self.physics.model.geom_pos[self.target]
        self.physics.model.geom_pos[self.target, :2] = -y, x
        self.physics.data.qpos[0] += np.pi / 2
        self.physics.forward()
        self.base = np.array([-self.base[1], self.base[0]]) + shift


def reach(observation):
    """Inverse kinematics and a PD law: the elbow on the side where it is."""
    shoulder, wrist, *_, x, y, turn, bend = observation
    length = np.clip(np.hypot(x, y), 0.05, 0.235)
    fold = np.sign(wrist or 1) * np.arccos(length**2 / (2 * 0.12**2) - 1)
    ahead = np.arctan2(y, x) - fold / 2
    error = np.array([(ahead - shoulder + np.pi) % (2 * np.pi) - np.pi, fold - wrist])
    return np.clip(2 * error - 0.3 * np.array([turn, bend]), -1, 1)


gymnasium.register("RawReacher-v0", entry_point=RawReacher, max_episode_steps=250)
