"""What codes are worth, side by side."""

from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from pathlib import Path

import numpy as np

from jbrep.dataset import Dataset
from jbrep.encoders import FULL, find
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.lanes import Lanes
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import EVALUATION, WORTH, Evaluation, Learned, Worth
from jbrep.progress import Progress
from jbrep.records.lock import exclusive
from jbrep.study.tables import references_of
from jbrep.training.trainer import single_torch_thread
from jbrep.worth import agents, offline
from jbrep.worth.offline import EPISODES, Ground

_AGENT = "agent"


def work_out(
    evaluation: Evaluation,
    encoders: Mapping[str, BaseEncoder],
    data: Dataset,
    folder: Path,
    kinds: Sequence[str],
    steps: int = agents.AGENT_STEPS,
    runs: int = agents.AGENT_RUNS,
) -> Evaluation:
    """Add what codes are worth to an evaluation, in its file, too.

    Args:
        evaluation: of the encoders.
        encoders: by label; the full observation is compared with them.
        data: that fitted and planning learn from.
        folder: of the evaluation; agents' runs are kept there, and go on if they were stopped.
        kinds: keys of WORTH.
        steps: of an agent.
        runs: of agents, of each code.

    Raises:
        InputError: agents where the environment can't be made; or there are no rewards.
    """
    every = {FULL: find(FULL, data.task), **encoders}
    ways = [way for kind in kinds for way in WORTH[kind] if way != _AGENT]
    with _lanes(data) as lanes, single_torch_thread():
        if lanes is None and _AGENT in kinds:
            raise InputError(
                f"the environment of {data.folder} can't be made here, or gives other rewards: no "
                "agent can be trained; ask for fitted or planning, which learn from the data alone"
            )
        rewards = np.asarray(data["reward"][:], np.float64)
        learned = dict[str, dict[str, Learned]]()
        if _AGENT in kinds:
            learned[_AGENT] = agents.learned(every, data.task, folder / "agents", steps, runs)
        if ways:
            learned |= _offline(every, Ground.of(data, lanes), ways)
        played = references_of(data.task, EPISODES) if lanes else {}
    worth = Worth(
        estimated=lanes is None,
        episodes=EPISODES,
        runs=runs if _AGENT in kinds else 0,
        steps=steps if _AGENT in kinds else 0,
        learned=learned,
        references={policy: float(each.mean()) for policy, each in played.items()},
        rewards=(float(rewards.mean()), float(rewards.std())),
    )
    path, added = folder / EVALUATION, evaluation.replace(worth=worth)
    with exclusive(path, beside=True):
        added.write(path)
    return added


def _lanes(data: Dataset) -> "closing[Lanes] | nullcontext[None]":
    """Where what was learned is played; nothing if that isn't here, or gives other rewards."""
    if data.manifest.settings.reward:
        return nullcontext()
    try:
        return closing(Lanes(data.task, EPISODES))
    except (InputError, ModuleNotFoundError):
        return nullcontext()


def _offline(
    encoders: Mapping[str, BaseEncoder], ground: Ground, ways: Sequence[str]
) -> dict[str, dict[str, Learned]]:
    """Of each way of learning from data, by label."""
    learned: dict[str, dict[str, Learned]] = {way: {} for way in ways}
    with Progress(total=len(ways) * len(encoders), unit="code") as progress:
        for way in ways:
            for label, encoder in encoders.items():
                progress.set_description_str(f"{label} {way}", refresh=False)
                learned[way][label] = offline.learned(encoder, ground, way)
                progress.update()
    return learned
