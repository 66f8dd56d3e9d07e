"""Episodes: many lanes stepped under a policy, and what they go through recorded."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.jitterbug.simulation import Simulation
from jbrep.jitterbug.tasks import Array

Actor = Callable[[Array], Array]  # observations (n, d) to actions (n, 1), once for each step
Tick = Callable[[int], object]  # called with the number of control steps just made, over all lanes


class Step(NamedTuple):
    """A control step that n lanes have just made."""

    number: int  # from 0
    observation: Array  # before it, (n, d)
    action: Array  # held for it, (n, 1)
    diverged: NDArray[np.bool_]  # whether the physics has diverged, now or before, (n,)


def open_loop(actions: NDArray[Any]) -> Actor:
    """The actor that plays given actions (T, n, 1), one after the other."""
    remaining = iter(actions)
    return lambda observation: next(remaining)


def run(simulation: Simulation, act: Actor, steps: int) -> Iterator[Step]:
    """Step all lanes; while a step is yielded, the simulation is in the state it led to."""
    for number in range(steps):
        observation = simulation.observe()
        action = act(observation)
        yield Step(number, observation, action, simulation.step(action))


@dataclass(frozen=True, eq=False)
class Recording:
    """What n lanes went through in T control steps; the first axis is time.

    Attributes:
        start: the state before the first step, as `Simulation.restore` takes it.
        states: before, between and after the steps, (T + 1, n, ...) each: the observation in
            float32, and the chosen fields of `Readings`.
        action: (T, n, 1).
        reward: of the states that the steps led to, (T, n), float32.
        length: number of steps before the physics diverged, T if it didn't, (n,).
    """

    start: dict[str, Array]
    states: dict[str, NDArray[Any]]
    action: Array
    reward: NDArray[np.float32]
    length: NDArray[np.int32]

    def __repr__(self) -> str:
        steps, lanes = self.reward.shape
        return f"Recording({lanes} lanes, {steps} steps of {', '.join(self.states)})"


def record(
    simulation: Simulation, act: Actor, steps: int, readings: Sequence[str], tick: Tick
) -> Recording:
    """Run all lanes and record them.

    Args:
        simulation: with its lanes at the start of their episodes.
        act: the policy.
        steps: how many.
        readings: names of the fields of `Readings` to record.
        tick: called after each step.
    """
    n, now = simulation.num_lanes, simulation.readings
    states = {name: np.empty((steps + 1, *getattr(now, name).shape)) for name in readings}
    observation = np.empty((steps + 1, n, simulation.task.size), np.float32)
    action = np.empty((steps, n, 1))
    reward = np.empty((steps, n), np.float32)
    length = np.zeros(n, np.int32)
    start = simulation.state
    for name, values in states.items():
        values[0] = getattr(now, name)
    for step in run(simulation, act, steps):
        observation[step.number] = step.observation
        action[step.number] = step.action
        reward[step.number] = simulation.reward()
        for name, values in states.items():
            values[step.number + 1] = getattr(simulation.readings, name)
        length += ~step.diverged
        tick(n)
    observation[steps] = simulation.observe()
    return Recording(start, {"observation": observation, **states}, action, reward, length)
