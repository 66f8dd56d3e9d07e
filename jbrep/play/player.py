"""Policies with their tasks, which play the episodes that every run is evaluated on."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.environments import Environments, envs_at_once
from jbrep.envs.make import is_batched, is_one_robot
from jbrep.envs.physics import MotionReader
from jbrep.envs.recording import Actor, Outcome, Recording, joined, record, whole_outcome
from jbrep.envs.task import Array, Task
from jbrep.play.rollout import Rollout
from jbrep.progress import Progress
from jbrep.rl.files import EVALUATION_SEED

Begin = Callable[[Task, Sequence[int]], Actor]  # as `Policy.begin`

_BATCH_ENVS, _SEPARATE_ENVS = 1000, 16  # that `returns` steps at once


class Player(NamedTuple):
    """A policy with its task."""

    name: str
    task: Task
    begin: Begin
    representation: str = FULL  # what the policy observes
    evaluation_batch: int = 1  # episodes that its evaluation plays at once
    step: int | None = None  # of training, if it is not over
    encoder: BaseEncoder | None = None  # of a trained policy that doesn't observe all features

    def play(
        self, episodes: Sequence[int], begun: Callable[[Environments], object] = lambda envs: None
    ) -> list[Rollout]:
        """Play some of the episodes that every run is evaluated on.

        Args:
            episodes: their numbers, from 0.
            begun: what is done to them before their first step.
        """
        if len(episodes) > 1 and (not self.task.reproducible or is_one_robot(self.task, None)):
            return [each for episode in episodes for each in self.play([episode], begun)]
        seeds = [EVALUATION_SEED + episode for episode in episodes]
        act, read = self.begin(self.task, seeds), MotionReader()
        with (
            Environments(self.task, len(seeds)) as envs,
            _progress(len(seeds) * self.task.max_episode_steps) as bar,
        ):
            envs.reset(range(len(seeds)), seeds)
            begun(envs)
            recording = record(envs, act, bar.update, read)
        return [self._rollout(recording, index, seed, read) for index, seed in enumerate(seeds)]

    def play_one(self, episode: int) -> Rollout:
        """Play one of these episodes as its evaluation does, without the others.

        What is observed goes through the network at its place in a batch of that size: elsewhere it
        rounds differently.
        """
        size = self.evaluation_batch
        place = episode % size

        def begin(task: Task, seeds: Sequence[int]) -> Actor:
            act = self.begin(task, seeds)
            return lambda seen: act(seen.repeat(size, axis=0))[[place]]

        return self._replace(begin=begin).play([episode])[0]

    def _rollout(self, recording: Recording, index: int, seed: int, read: MotionReader) -> Rollout:
        steps = int(recording.length[index])
        return Rollout(
            task=self.task,
            name=self.name,
            seed=seed,
            observation=recording.observation[: steps + 1, index],
            action=recording.action[:steps, index],
            reward=recording.reward[:steps, index],
            terminated=bool(recording.terminated[index]),
            motion=read.motion(recording, index, steps),
            encoder=self.encoder,
        )

    def returns(self, count: int, threads: int | None = None, retries: int = 0) -> Array:
        """Returns of the first `count` of these episodes, (count,).

        Threads are those to step a batch on, or instances of other environments, which are also
        played in one where no second can be made.
        """
        return joined(self.outcomes_in_turn(count, threads, retries)).returns

    def outcomes_in_turn(
        self, count: int, threads: int | None = None, retries: int = 0
    ) -> Iterator[Outcome]:
        """The same with what `info` tells, some episodes at a time, as they are finished."""
        most = _BATCH_ENVS
        if not is_batched(self.task):
            most = min(threads or _SEPARATE_ENVS, _SEPARATE_ENVS)
        played = 0
        with _progress(count * self.task.max_episode_steps) as bar:
            while played < count:
                most = min(most, count - played)
                with envs_at_once(self.task, most, threads, retries) as envs:
                    size, most = envs.num_envs, envs.num_envs
                    while played + size <= count:
                        first = EVALUATION_SEED + played
                        begin = partial(self.begin, self.task, range(first, first + size))
                        yield whole_outcome(envs, begin, first, bar.update)
                        played += size

    def with_reconstruction(self, encoder: BaseEncoder) -> "Player":
        """The same policy, which now observes what an encoder's latent is decoded to.

        The return that it loses measures what the latent lacks for acting.
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


def _progress(steps: int) -> Progress:
    return Progress(total=steps, unit="step", unit_scale=True, leave=False, delay=1)
