"""Where an episode to look at comes from: a data set, a trained run, or a policy by its name."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.collect.policies import POLICIES, Actor, parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import Encoder
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import Task, get_task
from jbrep.rl.files import EVALUATION_SEED, RUN, read_run
from jbrep.rollouts.rollout import Begin, Rollout, play, replay


class Player(NamedTuple):
    """A policy with its task."""

    name: str
    task: Task
    begin: Begin
    evaluation_batch: int = 1  # episodes that its evaluation played at once

    def play(self, episodes: Sequence[int], target_yaw: float | None = None) -> list[Rollout]:
        """Episodes of those that every run is evaluated on, by their numbers from 0."""
        seeds = [EVALUATION_SEED + episode for episode in episodes]
        return play(self.task, self.begin, self.name, seeds, target_yaw)

    def with_reconstruction(self, encoder: Encoder) -> "Player":
        """The same policy, but that it observes what an encoder's latent is decoded to.

        What it loses by that is what the latent lacks for it.

        Raises:
            InputError: an encoder for other observations.
        """
        encoder.check_task(self.task)

        def begin(task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
            act = self.begin(task, randoms)
            return lambda seen: act(encoder.decode(encoder.encode(seen.astype(np.float32))))

        return self._replace(name=f"{self.name} on {encoder.name}, decoded", begin=begin)


def find_episode(source: str, episode: int = 0, task: str | None = None) -> Rollout:
    """An episode of a data set by its number, or one under a policy that `find_player` knows.

    Those under a policy are the episodes of evaluation. Of a run they come out as they did when it
    was evaluated, which takes all of them at once: a network rounds otherwise for another number.

    Raises:
        InputError: as `find_player`, or there is no such episode.
    """
    if exists(Path(source) / MANIFEST):
        return replay(Dataset(source), episode)
    player = find_player(source, task)
    if episode < 0:
        raise InputError(f"there is no episode {episode}: they count from 0")
    if episode < player.evaluation_batch:
        return player.play(range(player.evaluation_batch))[episode]
    return player.play([episode])[0]


def find_player(source: str, task: str | None = None) -> Player:
    """The policy of a run's folder, or one by its name, such as heuristic or constant:drive=0.5.

    Args:
        source: which.
        task: for a policy by its name.

    Raises:
        InputError: neither, or no task to a name, or a run of another task.
    """
    if exists(Path(source) / MANIFEST):
        raise InputError(f"{source} is a data set: the folder of a run or a policy is needed")
    if exists(Path(source) / RUN):
        return _of_run(Path(source), task)
    if source.partition(":")[0] not in POLICIES:
        raise InputError(
            f"{source} is no data set, no folder of a run that is over, and no policy: those are "
            f"{', '.join(POLICIES)}"
        )
    if task is None:
        raise InputError(f"policy {source} needs a --task")
    return Player(source, get_task(task), parse_policy(source).begin)


def _of_run(folder: Path, task: str | None) -> Player:
    from jbrep.rl.policy import load_run  # brings torch

    trained = load_run(folder)
    if task not in (None, trained.task):
        raise InputError(f"{folder} is a run of {trained.task}, not of {task}")
    evaluation_batch = read_run(folder)["settings"]["evaluation_episodes"]
    return Player(str(folder), get_task(trained.task), trained.begin, evaluation_batch)
