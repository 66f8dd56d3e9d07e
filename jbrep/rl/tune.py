"""A search for settings of an algorithm, by Optuna; each trial is a run for each seed."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import optuna
from msgspec import Meta
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState

from jbrep.errors import InputError, differences
from jbrep.records.document import Document, read_document
from jbrep.records.record import Version
from jbrep.records.storage import exclusive, exists, make_folder, write_whole
from jbrep.rl.files import FINISHED, last_returns, read_evaluations
from jbrep.rl.learner import preset_text
from jbrep.rl.overrides import setting_names
from jbrep.rl.run import Run
from jbrep.rl.run_settings import RunSettings
from jbrep.rl.training import Session, train

SEARCH, BEST = "search.json", "best.toml"
_MOST_SEEDS = 1_000
_CHOICES: dict[str, list[Any]] = {
    "batch_size": [64, 128, 256, 512],
    "gamma": [0.9, 0.95, 0.98, 0.99, 0.995, 0.999],
    "tau": [0.001, 0.005, 0.01, 0.02, 0.05],
    "train_freq": [1, 4, 16],
    "gae_lambda": [0.8, 0.9, 0.95, 0.98, 1.0],
    "clip_range": [0.1, 0.2, 0.3],
    "n_epochs": [4, 10, 20],
    "vf_coef": [0.25, 0.5, 1.0],
    "target_kl": [0.005, 0.01, 0.02],
    "net_arch": [[64, 64], [256, 256], [400, 300]],
}
_SPACE: dict[str, BaseDistribution] = {
    "learning_rate": FloatDistribution(1e-5, 1e-2, log=True),
    **{n: CategoricalDistribution([*map(json.dumps, each)]) for n, each in _CHOICES.items()},
}


class Search(Document, frozen=True, kw_only=True):
    """search.json: what is searched, by which all trials and their order are decided."""

    format = "jbrep search"
    format_version = 2

    settings: RunSettings  # that all trials begin with
    seeds: Annotated[int, Meta(ge=1)]  # runs of each trial
    optuna: Version  # of the package


class Trial(NamedTuple):
    """What a trial came to."""

    number: int  # from 0
    overrides: dict[str, Any]
    value: float | None  # mean return of the last evaluations; None if a run failed


def tune(
    run: Run,
    trials: int,
    seeds: int,
    folder: Path,
    watch: Callable[[Trial], object] = lambda trial: None,
    stop: Callable[[], bool] = lambda: False,
) -> Trial:
    """Search for the settings with the largest return, and write them as a preset file, `BEST`.

    What is tried next follows from the search and from what the trials before it came to, which
    their runs' files say: the same search resumes where it was stopped, to the same trials.

    Args:
        run: what each trial trains, with other settings; those that it sets itself are kept. Its
            seed is the search's, too.
        trials: how many in all.
        seeds: how many runs each trial has, with the run's seed and those that follow.
        folder: of this search alone.
        watch: called with each trial that has ended.
        stop: asked before each rollout; once it is true, the run stops with a StoppedError.

    Returns:
        The best trial.
    """
    settings = run.settings(run.find_encoder())
    if not 1 <= seeds <= _MOST_SEEDS:
        raise InputError(f"seeds is {seeds:,}: it must be from 1 to {_MOST_SEEDS:,}")
    run.replace(seed=run.seed + seeds - 1)  # whose seed must be possible, too
    if settings.steps <= settings.learns_from:
        raise InputError(
            f"steps is {settings.steps:,}, and {settings.learner} learns from step "
            f"{settings.learns_from:,} on: take more, or another preset"
        )
    search = Search(settings=settings, seeds=seeds, optuna=optuna.__version__)
    make_folder(folder, (SEARCH, BEST, "trial-*"))
    with exclusive(folder):
        _claim(folder / SEARCH, search)
        if (begun := len([*folder.glob("trial-*")])) > trials:
            raise InputError(f"{folder} has {begun} trials: ask for as many, or more")
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(direction="maximize")
        ended = []
        for number in range(trials):
            ended.append(_trial(study, number, run, seeds, folder, stop))
            watch(ended[number])
        sound = [trial for trial in ended if trial.value is not None]
        if not sound:
            raise InputError("every trial failed: see the run.json files below the folder")
        best = max(sound, key=lambda trial: trial.value or 0.0)
        write_whole(folder / BEST, preset_text(run.learner.overridden(best.overrides)).encode())
        return best


def _claim(path: Path, search: Search) -> None:
    if not exists(path):
        search.write(path)
        return
    there = read_document(path, Search)
    before, now = ({"seeds": each.seeds, "optuna": each.optuna} for each in (there, search))
    if differing := there.settings.differing(search.settings) or differences(before, now):
        raise InputError(f"{path.parent} holds another search: {differing}; choose another folder")


def _space(run: Run) -> dict[str, BaseDistribution]:
    there, given = setting_names(run.learner.algorithm), {*run.learner.overrides}
    if "gradient_steps" in run.learner.hyperparameters.algorithm_kwargs:
        given.add("train_freq")  # else there would be so many after each of its steps
    return {name: each for name, each in _SPACE.items() if name in there and name not in given}


def _overrides(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {n: json.loads(v) if isinstance(v, str) else v for n, v in parameters.items()}


def _trial(
    study: optuna.Study, number: int, run: Run, seeds: int, folder: Path, stop: Callable[[], bool]
) -> Trial:
    seed = int(np.random.SeedSequence([run.seed, number]).generate_state(1)[0])
    study.sampler = optuna.samplers.TPESampler(seed=seed)  # whatever was drawn before
    asked = study.ask(_space(run))
    overrides = _overrides(asked.params)
    trained = run.replace(learner=run.learner.overridden(overrides))
    own = folder / f"trial-{number}"
    value = _score(trained, range(run.seed, run.seed + seeds), own, stop)
    study.tell(asked, value, TrialState.FAIL if value is None else TrialState.COMPLETE)
    return Trial(number, overrides, value)


def _score(run: Run, seeds: range, folder: Path, stop: Callable[[], bool]) -> float | None:
    last: list[float] = []
    for seed in seeds:
        own = folder / f"seed-{seed}"
        if train(run.replace(seed=seed), own, Session(stop=stop)).status != FINISHED:
            return None
        last += last_returns(read_evaluations(own))
    return float(np.mean(last))
