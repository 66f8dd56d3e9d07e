"""Where an episode comes from: a data set, a trained run, or a policy by its name."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jbrep.collect.policies import POLICIES, Actor, parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import FULL, Encoder
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.jitterbug.tasks import EPISODE_STEPS, Task, get_task
from jbrep.rl.fields import MAX_EVALUATION_EPISODES
from jbrep.rl.files import EVALUATION_SEED, POLICY, is_run
from jbrep.rollouts.rollout import Begin, Rollout, play, replay

if TYPE_CHECKING:
    from jbrep.rl.policy import Trained

_BATCH_STEPS = 10**6  # control steps that `play_first` holds in memory at once
_MAX_STEPS = 10**7  # the same, that `play` may return: about 350 bytes each


class Player(NamedTuple):
    """A policy with its task."""

    name: str
    task: Task
    begin: Begin
    representation: str = FULL  # what the policy observes
    evaluation_batch: int = 1  # episodes that its evaluation plays at once
    episode_steps: int = EPISODE_STEPS
    step: int | None = None  # of training, if it is not over

    def play(self, episodes: Sequence[int], target_yaw: float | None = None) -> list[Rollout]:
        """Play some of the episodes that every run is evaluated on.

        Args:
            episodes: their numbers, from 0.
            target_yaw: where every target points [rad]; where it points in the episode if None.

        Raises:
            InputError: too many steps to hold in memory.
        """
        if len(episodes) * self.episode_steps > _MAX_STEPS:
            raise InputError(
                f"{self.name} plays {len(episodes):,} episodes of {self.episode_steps:,} steps at "
                f"once: at most {_MAX_STEPS:,} steps are possible"
            )
        seeds = [EVALUATION_SEED + episode for episode in episodes]
        return play(self.task, self.begin, self.name, seeds, target_yaw, self.episode_steps)

    def play_first(self, count: int, target_yaw: float | None = None) -> Iterator[Rollout]:
        """Play the first `count` of these episodes, with bounded memory.

        Raises:
            InputError: more episodes than an evaluation may have.
        """
        if count > MAX_EVALUATION_EPISODES:
            raise InputError(
                f"{count:,} episodes are too many: at most {MAX_EVALUATION_EPISODES:,} are played"
            )
        batch = max(1, _BATCH_STEPS // self.episode_steps)
        for start in range(0, count, batch):
            yield from self.play(range(start, min(start + batch, count)), target_yaw)

    def with_reconstruction(self, encoder: Encoder) -> "Player":
        """The same policy, which now observes what an encoder's latent is decoded to.

        The return that it loses measures what the latent lacks for acting.

        Raises:
            InputError: an encoder for other observations.
        """
        encoder.check_task(self.task)

        def begin(task: Task, randoms: Sequence[np.random.Generator]) -> Actor:
            act = self.begin(task, randoms)
            return lambda seen: act(encoder.decode(encoder.encode(seen.astype(np.float32))))

        representation = f"{encoder.name}, decoded"
        return self._replace(
            name=f"{self.name} on {representation}", begin=begin, representation=representation
        )


def find_episode(source: str, episode: int = 0, task: str | None = None) -> Rollout:
    """An episode of a data set by its number, or one under a policy that `find_player` knows.

    Those under a policy are the episodes of evaluation. A run's come out as they did when it was
    evaluated, for which all of them are played at once: with another batch size its network rounds
    differently.

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
    """The policy of a run, or one by its name, such as heuristic or constant:drive=0.5.

    Args:
        source: the run's folder, or the policy.zip in it, or the name. A run that is not over plays
            its last checkpoint.
        task: for a policy by its name; of a run, it must be the run's.

    Raises:
        InputError: neither, or no task for a name, or a run of another task.
    """
    if folder := run_folder(source):
        return _of_run(folder, task)
    if exists(Path(source) / MANIFEST):
        raise InputError(f"{source} is a data set: give the folder of a run or a policy")
    if source.partition(":")[0] not in POLICIES:
        raise InputError(
            f"{source} is no data set, no run with a policy or checkpoint, and no policy by name: "
            f"those are {', '.join(POLICIES)}"
        )
    if task is None:
        raise InputError(f"policy {source} needs a --task")
    return Player(source, get_task(task), parse_policy(source).begin)


def run_folder(source: str) -> Path | None:
    """The folder of the run that a source names by it, or by its policy.zip; None for another."""
    path = Path(source)
    folder = path.parent if path.name == POLICY else path
    return folder if is_run(folder) else None


def find_untrained(folder: Path) -> Player:
    """The policy that a run began with.

    Raises:
        InputError: the run's files are damaged or inconsistent.
    """
    from jbrep.rl.policy import load_untrained  # imports torch

    return as_player(f"{folder}, before training", load_untrained(folder))


def _of_run(folder: Path, task: str | None) -> Player:
    from jbrep.rl.policy import load_run  # imports torch

    trained = load_run(folder)
    if task not in (None, trained.task):
        raise InputError(f"{folder} is a run of {trained.task}, not of {task}")
    name = str(folder) if trained.step is None else f"{folder} at step {trained.step:,}"
    return as_player(name, trained)


def as_player(name: str, trained: "Trained") -> Player:
    """A trained policy with a name."""
    return Player(
        name,
        get_task(trained.task),
        trained.begin,
        trained.representation,
        trained.evaluation_episodes,
        trained.episode_steps,
        trained.step,
    )
