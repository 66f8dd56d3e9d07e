"""Where an episode comes from: a data set, a trained run, or a policy by its name."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jbrep.collect.policies import POLICIES, Policy, make_policy, parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import FULL
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Actor, episode_returns
from jbrep.envs.task import Array, Task, check_same
from jbrep.errors import InputError
from jbrep.play.rollout import Begin, Rollout, play, replay
from jbrep.progress import Progress
from jbrep.records.storage import exists
from jbrep.rl import shipped
from jbrep.rl.fields import MAX_EVALUATION_EPISODES
from jbrep.rl.files import EVALUATION_SEED, POLICY, is_policy_file, is_run
from jbrep.rl.shipped import SHIPPED

if TYPE_CHECKING:
    from jbrep.rl.policy import Trained

_BATCH_BYTES = 350 * 10**6  # of the steps that `play_first` holds in memory at once
_MAX_BYTES = 10 * _BATCH_BYTES  # the same, that `play` may return
_BATCH_LANES, _SEPARATE_LANES = 1000, 16  # that `returns` steps at once


class Player(NamedTuple):
    """A policy with its task."""

    name: str
    task: Task
    begin: Begin
    representation: str = FULL  # what the policy observes
    evaluation_batch: int = 1  # episodes that its evaluation plays at once
    step: int | None = None  # of training, if it is not over

    def play(self, episodes: Sequence[int], target_yaw: float | None = None) -> list[Rollout]:
        """Play some of the episodes that every run is evaluated on.

        Args:
            episodes: their numbers, from 0.
            target_yaw: where every target points [rad]; where it points in the episode if None.

        Raises:
            InputError: too many steps to hold in memory.
        """
        if len(episodes) * self._episode_bytes > _MAX_BYTES:
            raise InputError(
                f"{self.name} plays {len(episodes):,} episodes of {self.task.max_episode_steps:,} "
                f"steps at once: at most {_MAX_BYTES // self._episode_bytes:,} are possible"
            )
        seeds = [EVALUATION_SEED + episode for episode in episodes]
        return play(self.task, self.begin, self.name, seeds, target_yaw)

    def play_first(self, count: int, target_yaw: float | None = None) -> Iterator[Rollout]:
        """Play the first `count` of these episodes, with bounded memory.

        Raises:
            InputError: more episodes than an evaluation may have.
        """
        for some in _batches(count, max(1, _BATCH_BYTES // self._episode_bytes)):
            yield from self.play(some, target_yaw)

    def returns(self, count: int) -> Array:
        """Returns of the first `count` of these episodes, (count,).

        Raises:
            InputError: more episodes than an evaluation may have.
        """
        most = _BATCH_LANES if is_batched(self.task) else _SEPARATE_LANES
        total, returns = count * self.task.max_episode_steps, []
        with Progress(total=total, unit="step", unit_scale=True, leave=False, delay=1) as progress:
            for some in _batches(count, most):
                lanes, first = Lanes(self.task, len(some)), EVALUATION_SEED + some[0]
                act = self.begin(self.task, range(first, first + len(some)))
                returns.append(episode_returns(lanes, act, first, progress.update))
                lanes.close()
        return np.concatenate(returns)

    @property
    def _episode_bytes(self) -> int:
        """About what an episode of the longest takes in memory."""
        return (16 * self.task.size + 100) * self.task.max_episode_steps

    def with_reconstruction(self, encoder: BaseEncoder) -> "Player":
        """The same policy, which now observes what an encoder's latent is decoded to.

        The return that it loses measures what the latent lacks for acting.

        Raises:
            InputError: an encoder for other observations, or one that can't decode.
        """
        encoder.check_task(self.task)
        encoder.check_decodes("a policy by its name acts on decoded observations")

        def begin(task: Task, seeds: Sequence[int]) -> Actor:
            act = self.begin(task, seeds)
            return lambda seen: act(encoder.decode(encoder.encode(seen.astype(np.float32))))

        representation = f"{encoder.name}, decoded"
        return self._replace(
            name=f"{self.name} on {representation}", begin=begin, representation=representation
        )


def _batches(count: int, most: int) -> Iterator[range]:
    """The first episodes of evaluation, at most so many at a time.

    Raises:
        InputError: more episodes than an evaluation may have.
    """
    if count > MAX_EVALUATION_EPISODES:
        raise InputError(
            f"{count:,} episodes are too many: at most {MAX_EVALUATION_EPISODES:,} are played"
        )
    for start in range(0, count, most):
        yield range(start, min(start + most, count))


def find_episode(
    source: str, episode: int = 0, task: Task | None = None, encoder: Any = None
) -> Rollout:
    """An episode of a data set by its number, or one under a policy that `find_player` knows.

    Those under a policy are the episodes of evaluation. A run's come out as they did when it was
    evaluated, for which all of them are played at once: with another batch size its network rounds
    differently.

    Raises:
        InputError: as `find_player`, or there is no such episode, or the data set is of another
            task.
    """
    if exists(Path(source) / MANIFEST):
        dataset = Dataset(source)
        _check_task(source, dataset.task, task)
        if task not in (None, dataset.task):
            raise InputError(
                f"{source} has its own arguments, time limit and features: leave out --task"
            )
        return replay(dataset, episode)
    player = find_player(source, task, encoder)
    if episode < 0:
        raise InputError(f"there is no episode {episode}: they count from 0")
    if episode < player.evaluation_batch:
        return player.play(range(player.evaluation_batch))[episode]
    return player.play([episode])[0]


def find_policy(text: str, folder: Path, task: Task) -> Policy:
    """The policy that a text names, to collect with: of a run, by its name, or a mixture of them.

    The policy of a run is frozen: it is the one that the data set has already, or else the run's
    last.

    Args:
        text: the run's folder or a policy's file, a name such as constant:drive=0.5, or a mixture
            such as uniform:0.5+runs/a:0.5.
        folder: of the data set.
        task: of the data set.

    Raises:
        InputError: it names nothing of these, or what it names can't be used.
        DamageError: a file isn't what was written.
    """
    files = (f"policy-{number}.safetensors" for number in count())

    def frozen(part: str) -> Policy | None:
        by_name = part.partition(":")[0] in POLICIES
        if not is_trained(part) and (by_name or not any(folder.glob("policy-*.safetensors"))):
            return None
        from jbrep.rl.frozen import freeze, has_kept  # imports torch

        file = next(files)
        if is_trained(part) or has_kept(part, folder / file):
            path = run_folder(part) or policy_file(part, task)
            return freeze(part if part == SHIPPED else str(path), path, folder, file)
        return None

    return parse_policy(text, frozen)


def kept_policy(folder: Path) -> Callable[[Mapping[str, Any]], Policy]:
    """How to make the policies of a data set in a folder from what its manifest says of them."""

    def trained(settings: Mapping[str, Any]) -> Policy:
        from jbrep.rl.frozen import read_frozen  # imports torch

        return read_frozen(folder, settings)

    return lambda settings: make_policy(settings, trained)


def is_trained(source: str) -> bool:
    """Whether a source is a run, a policy's file, or the policy that ships for a task."""
    return source == SHIPPED or run_folder(source) is not None or is_policy_file(Path(source))


def is_by_name(source: str) -> bool:
    """Whether a source is a policy by its name, which needs a task."""
    return source == SHIPPED or source.partition(":")[0] in POLICIES


def policy_names() -> str:
    """The names of policies, for messages."""
    return ", ".join((*POLICIES, SHIPPED))


def policy_file(source: str, task: Task | None) -> Path:
    """The path of the policy's file that a source names: that path, or the one that ships.

    Raises:
        InputError: none ships for the task, or no task is given.
    """
    return shipped.find(_needed(task, source)) if source == SHIPPED else Path(source)


def find_player(source: str, task: Task | None = None, encoder: Any = None) -> Player:
    """The policy of a run, or one by its name, such as heuristic or constant:drive=0.5.

    Args:
        source: the run's folder, or the policy.zip in it, a policy's file, or the name; trained is
            the one that ships for the task. A run that is not over plays its last checkpoint.
        task: for a policy by its name. A run has its own; if one is given, it must be of the same
            environment, and is played instead: with other arguments or another time limit.
        encoder: the object that a run was made with, if its encoder is a user's own.

    Raises:
        InputError: neither, or no task for a name, or a run of another task.
    """
    if is_trained(source):
        return _trained(source, task, encoder)
    if exists(Path(source) / MANIFEST):
        raise InputError(f"{source} is a data set: give the folder of a run or a policy")
    if not is_by_name(source):
        raise InputError(
            f"{source} is no data set, no run with a policy or checkpoint, and no policy by name: "
            f"those are {policy_names()}"
        )
    return Player(source, _needed(task, source), parse_policy(source).begin)


def _needed(task: Task | None, policy: str) -> Task:
    if task is None:
        raise InputError(f"policy {policy} needs a --task")
    return task


def run_folder(source: str) -> Path | None:
    """The folder of the run that a source names by it, or by its policy.zip; None for another."""
    path = Path(source)
    folder = path.parent if path.name == POLICY else path
    return folder if source != SHIPPED and is_run(folder) else None


def find_untrained(folder: Path, task: Task) -> Player:
    """The policy that a run began with, to play a task of the same environment.

    Raises:
        InputError: the run's files are damaged or inconsistent.
    """
    from jbrep.rl.policy import load_untrained  # imports torch

    player = as_player(f"{folder}, before training", load_untrained(folder))
    return player._replace(task=task)


def _trained(source: str, task: Task | None, encoder: Any) -> Player:
    from jbrep.rl.policy import load_run  # imports torch
    from jbrep.rl.policy_weights import load

    folder = run_folder(source)
    trained = load_run(folder, encoder) if folder else load(policy_file(source, task))
    name = str(folder or source)
    _check_task(name, trained.task, task)
    if trained.step is not None:
        name = f"{name} at step {trained.step:,}"
    player = as_player(name, trained)
    return player._replace(task=task) if task else player


def _check_task(source: str, own: Task, given: Task | None) -> None:
    """Make sure that a task that is given, if any, is the source's."""
    if given and given.id != own.id:
        raise InputError(f"{source} is of {own.name}, not of {given.name}")
    if given:
        check_same(given, own, source)


def as_player(name: str, trained: "Trained") -> Player:
    """A trained policy with a name."""
    return Player(
        name,
        trained.task,
        trained.begin,
        trained.representation,
        trained.evaluation_episodes,
        trained.step,
    )
