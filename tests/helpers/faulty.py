"""A small robot that is well made, and the same with one fault each."""

import gymnasium
import numpy as np
from gymnasium import spaces

_ANY = {"shape": (1,), "dtype": np.float64}


class Arm(gymnasium.Env):
    """A driven pendulum, and a joint that is moved beside it."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    dt = 0.05

    def __init__(self):
        self.reset(seed=0)
        self.observation_space = spaces.Dict(
            {name: spaces.Box(-np.inf, np.inf, **_ANY) for name in self.observed()}
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        draw = self.np_random.uniform
        self.angle, self.speed, self.tilt = draw(-3, 3), draw(-1, 1), draw(-0.3, 0.3)
        self.place, self.before = draw(-1, 1), []
        return self.observation(), {}

    def step(self, action):
        push, move = self.acts(action.astype(float))
        self.speed += self.dt * (4 * np.sin(self.angle) - 0.3 * self.speed + 8 * push)
        self.angle += self.dt * self.speed
        self.tilt = 0.95 * self.tilt + 0.1 * move
        self.place += self.dt * self.tilt
        return self.observation(), float(self.reward(action)), False, False, {}

    def observation(self):
        return {name: np.array([value]) for name, value in self.observed().items()}

    def turn(self):
        return (self.angle + np.pi) % (2 * np.pi) - np.pi

    def joints(self):
        return {"speed": self.speed, "tilt": self.tilt}

    def observed(self):
        return {"cos": np.cos(self.angle), "sin": np.sin(self.angle), **self.joints()}

    def acts(self, action):
        return action

    def reward(self, action):
        return np.cos(self.angle) - 0.02 * self.speed**2 - self.tilt**2


class Wrapped(Arm):
    def observed(self):
        return {"heading": self.turn(), **self.joints()}


class Signs(Arm):
    def observed(self):
        half, other = self.turn() / 2, self.tilt
        w, x = np.cos(half) * np.array([np.cos(other), np.sin(other)])
        z, y = np.sin(half) * np.array([np.cos(other), np.sin(other)])
        return {"q0": w, "q1": x, "q2": y, "q3": z, "speed": self.speed}


class Degrees(Arm):
    def joints(self):
        return {"speed": self.speed, "tilt_deg": np.degrees(self.tilt)}


class Copied(Arm):
    def joints(self):
        return {**super().joints(), "tacho": 1 - 2 * self.speed}


class Stuck(Arm):
    def joints(self):
        return {**super().joints(), "battery": 0.5}


class Saturated(Arm):
    def joints(self):
        return {**super().joints(), "gauge": np.clip(self.tilt, -0.2, 0.2)}


class Scales(Arm):
    def joints(self):
        return {"speed": self.speed, "tilt": 2000 * self.tilt}


class World(Arm):
    def joints(self):
        return {**super().joints(), "place": self.place}


class Hidden(Arm):
    def joints(self):
        return {"tilt": self.tilt}


class Delayed(Arm):
    def acts(self, action):
        self.before.append(action)
        return self.before[-3] if len(self.before) > 2 else 0 * action


class Sparse(Arm):
    def reward(self, action):
        return np.cos(self.angle) > 0.98 and abs(self.speed) < 0.7


class OfAction(Arm):
    def reward(self, action):
        return -(float(action[0]) ** 2)


class Unpredictable(Arm):
    def reward(self, action):
        return self.np_random.normal()


class Unseeded(Arm):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.speed += np.random.default_rng().normal()
        return self.observation(), {}


class Dead(Arm):
    def acts(self, action):
        return 0 * action

    def observed(self):
        return {"battery": 0.5, "load": 2.0}


class Turned(Arm):
    """Whose heading goes from 0 to 2 pi."""

    def observed(self):
        return {"heading": self.angle % (2 * np.pi), **self.joints()}


FAULTS = {  # what each is found for, and about which features
    Arm: None,
    Wrapped: ("wraps", ("heading",)),
    Signs: ("signs", ("q0", "q1", "q2", "q3")),
    Degrees: ("degrees", ("tilt_deg",)),
    Copied: ("copy", ("tacho", "speed")),
    Stuck: ("constant", ("battery",)),
    Saturated: ("saturated", ("gauge",)),
    Scales: ("scales", ("tilt",)),
    World: ("world", ("place",)),
    Hidden: ("hidden", None),
    Delayed: ("delay", None),
    Sparse: ("sparse", ()),
    OfAction: ("reward", ()),
    Unpredictable: ("reward", ()),
    Unseeded: ("random", ()),
}
for _robot in (*FAULTS, Dead, Turned):
    gymnasium.register(f"Faulty/{_robot.__name__}-v0", entry_point=_robot, max_episode_steps=100)
