"""Robots as many a lab has them: raw angles, a Dict of sensors, unbounded commands, an own XML."""

from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box, Dict
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
        return np.float32([x, v, wrapped(angle), turn])

    def step(self, action):
        _, v, angle, turn = self.state
        sine, cosine = np.sin(angle), np.cos(angle)
        push = (10 * float(action[0]) + 0.05 * turn**2 * sine) / 1.1
        spin = (9.8 * sine - cosine * push) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
        force = push - 0.05 * spin * cosine / 1.1
        self.state = self.state + self.dt * np.array([v, force, turn, spin])
        height = (1 + np.cos(self.state[2])) / 2
        reward = float(height * max(0, 1 - (self.state[0] / 2.4) ** 2))  # none is below 0
        return self.seen(), reward, bool(abs(self.state[0]) > 2.4), False, {}


class Balancer(gymnasium.Env):
    """A robot on two wheels that drives to a target, and has fallen at a pitch of 0.8 rad."""

    observation_space = Dict(
        imu=Box(-10, 10, (2,)),  # pitch [rad], its speed
        wheels=Box(-10, 10, (2,)),  # speeds, left and right [m/s]
        heading=Box(-np.float32(np.pi), np.float32(np.pi), (1,)),  # [rad], of the world
        target=Box(-10, 10, (2,)),  # from the robot, along the world's axes [m]
    )
    dt = 0.02

    def __init__(self, bounded=True):
        limit = 1 if bounded else np.inf
        self.action_space = Box(-limit, limit, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.imu = self.np_random.normal(0, 0.05, 2)
        self.wheels = np.zeros(2)
        self.heading = self.np_random.uniform(-np.pi, np.pi)
        direction = self.np_random.uniform(-np.pi, np.pi)
        self.target = self.np_random.uniform(0.5, 1.5) * np.array(
            [np.cos(direction), np.sin(direction)]
        )
        return self.seen(), {}

    def seen(self):
        values = {
            "imu": self.imu,
            "wheels": self.wheels,
            "heading": [wrapped(self.heading)],
            "target": self.target,
        }
        return {name: np.clip(each, -10, 10).astype(np.float32) for name, each in values.items()}

    def step(self, action):
        push = 8 * np.clip(action, -1, 1) - self.wheels
        pitch, turn = self.imu
        lean = (9.8 * np.sin(pitch) - push.mean() * np.cos(pitch)) / 0.5
        self.imu = self.imu + self.dt * np.array([turn, lean])
        self.wheels = self.wheels + self.dt * push
        self.heading += self.dt * (self.wheels[1] - self.wheels[0]) / 0.4
        ahead = np.array([np.cos(self.heading), np.sin(self.heading)])
        self.target = self.target - self.dt * self.wheels.mean() * ahead
        reward = 1 / (1 + np.hypot(*self.target))
        return self.seen(), float(reward), bool(abs(self.imu[0]) > 0.8), False, {}

    def quarter_turn(self, shift):
        """Turn the world, with the target; where it is shifted to isn't seen."""
        self.heading += np.pi / 2
        self.target = np.array([-self.target[1], self.target[0]])


class AcroCart(MujocoEnv):
    """Two poles in a row on a cart, acrocart.xml; only the cart has a motor."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, **options):
        model = str(Path(__file__).with_name("acrocart.xml"))
        seen = Box(-np.inf, np.inf, (6,), np.float64)  # positions and speeds of its joints
        super().__init__(model, 4, seen, **options)

    def reset_model(self):
        noise = self.np_random.normal(0, 0.05, (2, 3))
        self.set_state(self.init_qpos + noise[0], self.init_qvel + noise[1])
        return self.seen()

    def seen(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.seen(), float(self.data.site("tip").xpos[2]), False, False, {}


def wrapped(angle):
    """An angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


gymnasium.register("RawPendulum-v0", entry_point=raw_pendulum, max_episode_steps=200)
gymnasium.register("RawCartPole-v0", entry_point=RawCartPole, max_episode_steps=500)
gymnasium.register("Balancer-v0", entry_point=Balancer, max_episode_steps=200)
gymnasium.register(
    "UnboundedBalancer-v0", entry_point=Balancer, max_episode_steps=200, kwargs={"bounded": False}
)
gymnasium.register("AcroCart-v0", entry_point=AcroCart, max_episode_steps=250)
