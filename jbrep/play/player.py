"""Policies with their tasks, which play the episodes that every run is evaluated on."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.envs.make import is_batched
from jbrep.envs.recording import Actor, episode_returns
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.play.rollout import Begin, Rollout, play
from jbrep.progress import Progress
from jbrep.rl.files import EVALUATION_SEED
from jbrep.rl.settings import MAX_EPISODES

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
    if count > MAX_EPISODES:
        raise InputError(f"{count:,} episodes are too many: at most {MAX_EPISODES:,} are played")
    for start in range(0, count, most):
        yield range(start, min(start + most, count))
