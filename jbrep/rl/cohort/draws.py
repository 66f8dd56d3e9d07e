"""What a run draws at random, from generators of its own, in the order of stable-baselines3."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from jbrep.records.container import Tensors
from jbrep.rl.presets import NormalNoise, OrnsteinUhlenbeckNoise

Noise = NormalNoise | OrnsteinUhlenbeckNoise


class Draws:
    """The generators of a run, as they are in this process after its agent was made.

    Args:
        actions: the agent's space of actions, from which random ones are drawn.
        lanes: of the run.
    """

    def __init__(self, actions: spaces.Space[Any], lanes: int, noise: Noise | None):
        self._actions, self._lanes, self._noise = actions, lanes, noise
        self.numpy = np.random.RandomState()
        self.numpy.set_state(np.random.get_state())  # noqa: NPY002 - stable-baselines3 seeded it
        self.torch = torch.Generator()
        self.torch.set_state(torch.get_rng_state())
        self.drift = np.zeros((lanes, *(actions.shape or ())))  # the last noise of each lane

    @property
    def state(self) -> tuple[Tensors, dict[str, Any]]:
        """What `restore` takes: tensors, and plain JSON."""
        numbers = self.numpy.get_state(legacy=False)
        tensors = {
            "numpy": numbers["state"].pop("key"),
            "torch": self.torch.get_state().numpy(),
            "drift": self.drift,
        }
        actions = self._actions.np_random.bit_generator.state
        return tensors, {"numpy": numbers, "actions": actions}

    def restore(self, tensors: Tensors, counters: Mapping[str, Any]) -> None:
        """Continue from a state."""
        numbers = counters["numpy"]
        state = {**numbers["state"], "key": tensors["numpy"]}
        self.numpy.set_state({**numbers, "state": state})
        self.torch.set_state(torch.from_numpy(tensors["torch"]))
        self.drift = tensors["drift"].copy()
        self._actions.np_random.bit_generator.state = counters["actions"]

    def random_actions(self) -> NDArray[np.float32]:
        """Actions within their bounds, (lanes, k)."""
        return np.array([self._actions.sample() for _ in range(self._lanes)])

    def noise(self) -> NDArray[np.float32]:
        """Noise on actions that are scaled to [-1, 1], (lanes, k)."""
        if self._noise:
            self.drift = self._noise.after(self.drift, self.numpy)
        return self.drift.astype(np.float32)

    def episode_ended(self, lane: int) -> None:
        """Let the lane's noise start at zero again."""
        self.drift[lane] = 0

    def places(self, filled: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The steps and lanes of a sample from replay memory, (size,) each."""
        steps = self.numpy.randint(0, filled, size=size)
        return steps, self.numpy.randint(0, high=self._lanes, size=size)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers."""
        return torch.empty(shape).normal_(generator=self.torch)
