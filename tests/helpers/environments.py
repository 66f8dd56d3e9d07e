"""A third party's package: importing it registers small environments with Gymnasium."""

import os
import signal

import gymnasium
import numpy as np
from gymnasium import spaces

from jbrep.envs import Feature, Task

_UNBOUNDED = spaces.Box(-np.inf, np.inf, (2,), np.float64)


class Sledge(gymnasium.Env):
    """A sledge on a rail, pushed by three thrusters; it falls off the rail's ends.

    Args:
        rail: half the length of the rail.
        wind: pushes it as well.
    """

    observation_space = _UNBOUNDED
    action_space = spaces.Box(
        np.array([-1, 0, -2], np.float32), np.array([1, 10, 0.5], np.float32), dtype=np.float32
    )
    dt = 0.05

    def __init__(self, rail=1.0, wind=0.0):
        self.rail, self.wind = rail, wind

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed, self.steps = seed, 0
        self.state = self.np_random.normal(0, 0.1, 2)
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        force = action @ np.array([1, 0.2, 0.8]) - 0.4 + self.wind + self.np_random.normal(0, 0.1)
        self.state += (0.05 * self.state[1], force)
        fallen = bool(abs(self.state[0]) > self.rail)
        return self.observe(), -float(abs(self.state[0])), fallen, False, {}

    def observe(self):
        return self.state.copy()


class Broken(Sledge):
    """A sledge that breaks at step 4 of an episode.

    Args:
        how: "raises", "nan", "huge", "reward" or "size".
        seed: of the episode.
    """

    def __init__(self, how="raises", seed=0):
        super().__init__(rail=9.0)
        self.how, self.breaking = how, seed

    def step(self, action):
        observation, reward, *others = super().step(action)
        if (self.seed, self.steps) == (self.breaking, 4):
            if self.how == "raises":
                raise RuntimeError("the rail broke\nin two")
            spoilt = {"nan": observation * np.nan, "huge": [1e39, -1e39], "size": np.zeros(3)}
            observation = spoilt.get(self.how, observation)
            reward = np.inf if self.how == "reward" else reward
        return observation, reward, *others


class Deadly(Sledge):
    """A sledge that takes its process along in the episode with a seed."""

    def __init__(self, seed=0):
        super().__init__()
        self.deadly = seed

    def reset(self, *, seed=None, options=None):
        if seed == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().reset(seed=seed)


class Moody(Sledge):
    """A sledge that starts where it likes, whatever the seed."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.random.default_rng().normal(0, 0.1, 2)
        return self.observe(), {}


class Worn(Sledge):
    """A sledge that every episode wears down: a used one differs from a fresh one."""

    episodes = 0

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return super().reset(seed=seed)

    def observe(self):
        return self.state + 1e-9 * self.episodes


class Nested(Sledge):
    """A sledge whose observation is a dictionary with another in it, and a tuple."""

    observation_space = spaces.Dict(
        {
            "sledge": spaces.Dict({"place": spaces.Box(-9, 9), "speed": spaces.Box(-9, 9)}),
            "signs": spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Discrete(3))),
            "odd key!": spaces.Box(0, 1, (1, 2)),
        }
    )

    def observe(self):
        place, speed = self.state[:, None].astype(np.float32)
        return {
            "sledge": {"place": place, "speed": speed},
            "signs": (np.sign(self.state).astype(np.float32), self.steps % 3),
            "odd key!": np.float32([[0.25, 0.75]]),
        }


class Exact(Sledge):
    """An environment whose bounds no number of 32 bits meets; it observes its action."""

    action_space = spaces.Box(np.array([0.1]), np.array([0.3]), dtype=np.float64)

    def step(self, action):
        assert self.action_space.contains(action), action
        self.steps += 1
        self.state = np.append(action, action - np.float32(action))
        return self.observe(), 0.0, self.steps == 7, self.steps == 7, {}


class Told(Sledge):
    """A sledge that describes itself, with arrays of its state that it doesn't observe."""

    def reset(self, *, seed=None, options=None):
        observation, _ = super().reset(seed=seed)
        self.colour = self.np_random.uniform(size=3)
        return observation, self.info()

    def step(self, action):
        *given, _ = super().step(action)
        return *given, self.info()

    def info(self):
        return {"heat": np.array([self.steps / 2]), "colour": self.colour.copy()}

    @staticmethod
    def describe(arguments, max_episode_steps):
        return Task(
            id="Sledges/Told-v0",
            name="Sledges/Told-v0",
            features=(Feature("place", "m", -1, 1), Feature("speed", "m/s", -3, 3)),
            action_low=(-1.0, 0.0, -2.0),
            action_high=(1.0, 10.0, 0.5),
            max_episode_steps=max_episode_steps or 40,
            arguments=arguments,
            terminates=True,
            reward_high=0.0,
            state={"heat": 1},
            constants={"colour": 3},
        )


class Scored(Sledge):
    """A sledge that tells numbers, as its seed says; it is at its goal at step 3 alone."""

    def step(self, action):
        observation, _, fallen, _, _ = super().step(action)
        odd = self.seed % 2
        info = {
            "is_success": np.bool_(odd and self.steps == 3),
            "slid": self.seed % 3 == 0,
            "steps": self.steps,
            "heat": np.float64(self.seed % 5) / 7,
            "broken": np.float32(np.nan),
            "place": observation,
            "mode": "free",
            "bad\nname": 1.0,
        }
        return observation, 1.0, fallen, self.steps == 6, info


class Free(Sledge):
    """A sledge with thrusters without bounds."""

    action_space = spaces.Box(-np.inf, np.inf, (3,))


class Filmed(Sledge):
    """A sledge that is observed by a camera."""

    observation_space = spaces.Box(0, 255, (32, 32, 3), np.uint8)


def refuse(**arguments):
    """A vector entry point that must not be used: such ones reset at the next step."""
    raise AssertionError("the vector environment was made")


LIMIT = 40
for _name, _made, _limit in (
    ("Sledge", Sledge, LIMIT),
    ("Broken", Broken, LIMIT),
    ("Deadly", Deadly, LIMIT),
    ("Moody", Moody, LIMIT),
    ("Worn", Worn, LIMIT),
    ("Nested", Nested, LIMIT),
    ("Exact", Exact, LIMIT),
    ("Told", Told, LIMIT),
    ("Scored", Scored, LIMIT),
    ("Free", Free, LIMIT),
    ("Filmed", Filmed, LIMIT),
    ("Endless", Sledge, None),
):
    gymnasium.register(
        f"Sledges/{_name}-v0",
        entry_point=_made,
        vector_entry_point=refuse if _name == "Sledge" else None,
        max_episode_steps=_limit,
        reward_threshold=-3.0 if _name == "Sledge" else None,
    )
