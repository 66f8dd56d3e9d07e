"""Single episodes to look at: replayed from a data set, or played by a policy."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jbrep.collecting.replay import is_equal, simulate_again
from jbrep.dataset import Dataset, Episode
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.physics import Motion, MotionReader
from jbrep.envs.task import Task
from jbrep.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """An episode of n steps; states are before, between and after the steps."""

    task: Task
    name: str  # where the episode comes from, for titles
    seed: int
    observation: NDArray[np.float32]  # of each state in physical units, (n + 1, d)
    action: NDArray[np.floating]  # (n, k)
    reward: NDArray[np.float32]  # of each step, (n,)
    terminated: bool  # whether a state ended the episode
    motion: Motion | None = None  # of the robot, n + 1 states; None where there is no MuJoCo
    note: str = ""  # why there is no motion though the environment may have one
    encoder: BaseEncoder | None = None  # of a trained policy that doesn't observe all features

    def __len__(self) -> int:
        return len(self.action)

    @property
    def episode_return(self) -> float:
        """Sum of the rewards."""
        return float(self.reward.sum(dtype=np.float64))


def replay(dataset: Dataset, episode: int) -> Rollout:
    """An episode of a data set, simulated again for the motion of its robot.

    Where that isn't possible here, or leads elsewhere, it is as stored, with a note and no motion.
    """
    stored = dataset.episode(episode)
    rollout = _as_stored(stored)
    read = MotionReader()
    try:
        recording = simulate_again([stored], read, tick=lambda steps: None)
    except (InputError, ModuleNotFoundError) as error:
        return replace(rollout, note=f"{rollout.name} is shown without the robot: {error}")
    if not is_equal(recording, 0, stored):
        note = (
            f"{rollout.name} is shown as stored, without the robot: simulated again it differs, as "
            f"{dataset.task.name} isn't reproducible here"
        )
        return replace(rollout, note=note)
    return replace(rollout, motion=read.motion(recording, 0, len(rollout)))


def _as_stored(episode: Episode) -> Rollout:
    ends = episode.record
    unknown = np.full(len(episode), np.nan, np.float32)
    return Rollout(
        task=episode.dataset.task,
        name=f"{episode.dataset.folder}, episode {episode.number}",
        seed=int(ends["seed"]),
        observation=np.concatenate((episode["observation"], ends["final_observation"][None])),
        action=episode["action"],
        reward=episode["reward"] if "reward" in episode.dataset.columns else unknown,
        terminated=bool(ends["terminated"]),
    )
