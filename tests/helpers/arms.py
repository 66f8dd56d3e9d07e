"""A robot on a serial port: it exists once, prints, fails now and then, and misses readings."""

from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces

ID = "Arms/Arm-v0"
STEPS = 25  # of an episode


class Arm(gymnasium.Env):
    """A joint that is pushed.

    Args:
        log: a file that gets a letter when the port is opened, closed, and at each failure.
        fails: numbers of the steps in this process at which the port fails.
        gaps: numbers of steps of an episode at which the reading is missing.
        clock: of the third feature, at the start.
        reward: how it is given: as a number, "array", or "pair".
        locked: whether a second joint can't move.
        drifts: whether what is read depends on how long the robot has run, as with a real one.
    """

    observation_space = spaces.Dict(
        angle=spaces.Box(-9, 9), speed=spaces.Box(-9, 9), clock=spaces.Box(-np.inf, np.inf)
    )
    ports = 0  # open in this process
    steps_of_all = 0

    def __init__(
        self, log, fails=(), gaps=(), clock=0.0, reward="number", locked=False, drifts=False
    ):
        self.log, self.fails, self.gaps, self.clock = Path(log), [*fails], [*gaps], clock
        self.reward, self.drifts = reward, drifts
        low, high = ([-1.0, 0.3], [1.0, 0.3]) if locked else ([-1.0], [1.0])
        self.action_space = spaces.Box(np.float32(low), np.float32(high))
        if Arm.ports:
            raise OSError("port busy")
        Arm.ports += 1
        self.write("o")

    def write(self, letter):
        with self.log.open("a") as file:
            file.write(letter)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        print("homing")
        self.steps = 0
        self.state = self.np_random.uniform(-0.1, 0.1, 2)
        self.state += self.drifts * 1e-6 * Arm.steps_of_all
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        action *= 0.5  # in the caller's array
        self.steps += 1
        Arm.steps_of_all += 1
        if Arm.steps_of_all in self.fails:
            self.write("f")
            raise OSError("no answer")
        self.state[1] += 0.1 * action[0]
        self.state[0] += 0.1 * self.state[1]
        reward = -float(self.state[0] ** 2)
        if self.steps in self.gaps:
            reward = np.nan
        shaped = {"array": np.array([reward]), "pair": np.array([reward, 0])}
        return self.observe(), shaped.get(self.reward, reward), False, False, {}

    def observe(self):
        angle, speed = self.state
        angle = np.nan if self.steps in self.gaps else angle
        clock = self.clock + 0.02 * self.steps
        return {"angle": [angle], "speed": [speed], "clock": np.array([clock])}

    def close(self):
        Arm.ports -= 1
        self.write("c")
        print("torque off")


gymnasium.register(ID, entry_point=Arm, max_episode_steps=STEPS)
