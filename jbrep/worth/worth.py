"""What codes are worth, side by side."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from jbrep.dataset import Dataset
from jbrep.encoders import FULL, find
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import EVALUATION, Evaluation, Learned, Worth
from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.study.tables import references_of
from jbrep.training.trainer import single_thread
from jbrep.worth import AGENT, WORTH, agents, offline
from jbrep.worth.offline import EPISODES, Ground


def check(data: Dataset, kinds: Sequence[str]) -> None:
    """Check, before anything else takes time, that what was asked for can be found out.

    Args:
        data: to learn from.
        kinds: keys of WORTH.

    Raises:
        InputError: agents where the environment can't be made; or data without rewards.
    """
    if set(kinds) - {AGENT}:
        data["reward"]  # says what to do if there are none
    with _lanes(data) as lanes:
        if lanes is None and AGENT in kinds:
            raise InputError(
                f"the environment of {data.folder} can't be made here, or gives other rewards: no "
                "agent can be trained; ask for fitted or planning, which learn from the data alone"
            )


def work_out(
    evaluation: Evaluation,
    encoders: Mapping[str, BaseEncoder],
    data: Dataset,
    folder: Path,
    kinds: Sequence[str],
) -> Evaluation:
    """Add what codes are worth to an evaluation, and each to its file as soon as it is known.

    What the evaluation has already stays.

    Args:
        evaluation: of the encoders.
        encoders: by label; the full observation is compared with them.
        data: that fitted and planning learn from.
        folder: of the evaluation; agents' runs are kept there, and go on if they were stopped.
        kinds: keys of WORTH.
    """
    every = {FULL: find(FULL, data.task), **encoders}
    path = folder / EVALUATION
    with exclusive(path, beside=True), _lanes(data) as lanes, single_thread():
        found = _Found(evaluation, path, lanes is None)
        missing = {
            way: new
            for kind in kinds
            for way in WORTH[kind]
            if (new := {label: every[label] for label in found.missing(way, every)})
        }
        if missing and lanes and not found.worth.references:
            played = references_of(data.task, EPISODES)
            found.keep(references={policy: float(each.mean()) for policy, each in played.items()})
        if missing.pop(AGENT, None):
            _train(found, every, data, folder)
        if missing:
            _learn(found, missing, Ground.of(data, lanes))
    return found.evaluation


class _Found:
    """An evaluation whose file has what codes are worth, as far as that is known.

    Args:
        evaluation: to begin with.
        path: of its file.
        estimated: whether the environment can't be made.

    Raises:
        InputError: what was estimated would stand beside what is played.
    """

    def __init__(self, evaluation: Evaluation, path: Path, estimated: bool):
        if (before := evaluation.worth) and before.learned and before.estimated != estimated:
            how = ("estimated", "can") if before.estimated else ("played", "can't")
            raise InputError(
                f"{path} has returns that were {how[0]}, and the environment {how[1]} be made now: "
                "--import the module that it needs, or choose another --out"
            )
        self.worth = before or Worth(estimated=estimated, episodes=EPISODES)
        self.evaluation, self._path = evaluation, path

    def missing(self, way: str, labels: Mapping[str, Any]) -> list[str]:
        """Which codes aren't known by a way of learning."""
        return [label for label in labels if label not in self.worth.learned.get(way, {})]

    def keep(self, **known: Any) -> None:
        """Write what became known of the worth."""
        self.worth = self.worth.replace(**known)
        self.evaluation = self.evaluation.replace(worth=self.worth)
        self.evaluation.write(self._path)

    def learned(self, way: str, known: Mapping[str, Learned]) -> None:
        """Write what a way of learning made of codes; the surest way stays the first."""
        ways = dict(self.worth.learned)
        ways[way] = {**ways.get(way, {}), **known}
        order = [each for several in WORTH.values() for each in several]
        self.keep(learned={each: ways[each] for each in order if each in ways})

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Add CPU seconds to those that agents took, however they end."""
        began = time.process_time()
        try:
            yield
        finally:
            seconds = self.worth.agent_seconds + time.process_time() - began
            self.keep(agent_seconds=seconds)


def _train(found: _Found, encoders: Mapping[str, BaseEncoder], data: Dataset, folder: Path) -> None:
    with found.counting():
        scores = agents.learned(encoders, data.task, folder / "agents")
    seconds = found.worth.agent_seconds / len(encoders)
    found.keep(runs=agents.RUNS, steps=agents.STEPS)
    found.learned(
        AGENT, {label: Learned(score=each, seconds=seconds) for label, each in scores.items()}
    )


def _learn(found: _Found, missing: Mapping[str, Mapping[str, BaseEncoder]], ground: Ground) -> None:
    """Learn from the data in each way what isn't known of each code."""
    found.keep(rewards=ground.rewards, ends=not ground.seen.continues.all())
    with Progress(total=sum(map(len, missing.values())), unit="code") as progress:
        for way, encoders in missing.items():
            for label, encoder in encoders.items():
                progress.set_description_str(f"{label} {way}", refresh=False)
                found.learned(way, {label: offline.learned(encoder, ground, way)})
                progress.update()


def _lanes(data: Dataset) -> "closing[Lanes] | nullcontext[None]":
    """Where what was learned is played; nothing if that isn't here, or gives other rewards."""
    if data.manifest.settings.reward:
        return nullcontext()
    try:
        return closing(Lanes(data.task, EPISODES))
    except (InputError, ModuleNotFoundError):
        return nullcontext()
