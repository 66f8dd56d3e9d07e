"""A mixture of policies, each of which acts in some of the episodes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.policy import MIXTURE
from jbrep.dataset.schema import episode_part
from jbrep.envs.recording import Actor
from jbrep.envs.task import Array, Task

if TYPE_CHECKING:
    from jbrep.collect.policies import Policy


@dataclass(frozen=True)
class Mixture:
    """A policy for each episode, drawn from several with the given weights."""

    parts: "tuple[tuple[float, Policy], ...]"  # weights, which are positive, and policies

    def files(self) -> dict[str, bytes]:
        """Those of its parts."""
        return {name: file for _, policy in self.parts for name, file in policy.files().items()}

    def settings(self) -> dict[str, Any]:
        """The settings that `make_policy` takes."""
        return {"kind": MIXTURE, "parts": [[w, policy.settings()] for w, policy in self.parts]}

    def begin(self, task: Task, seeds: Sequence[int]) -> Actor:
        """Act with the part that is drawn for each episode.

        Raises:
            InputError: a part can't act in this task.
        """
        weights = [weight for weight, _ in self.parts]
        drawn = np.array([episode_part(seed, weights) for seed in seeds], int)
        actors: list[tuple[NDArray[np.intp], Actor]] = []
        for part, (_, policy) in enumerate(self.parts):
            lanes = np.flatnonzero(drawn == part)
            actors.append((lanes, policy.begin(task, [seeds[int(lane)] for lane in lanes])))

        def act(observation: Array) -> NDArray[Any]:
            actions = np.empty((len(observation), task.action_size))
            for lanes, part in actors:
                if len(lanes):
                    actions[lanes] = part(observation[lanes])
            return actions

        return act
