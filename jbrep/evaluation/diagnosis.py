"""Encoders side by side on the held-out part of a data set."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import UNSET

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.settings import IMPORTED
from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.header import EncoderHeader
from jbrep.encoders.shipped import UNLEARNED
from jbrep.errors import InputError
from jbrep.evaluation import control, readout
from jbrep.evaluation.control import GoodPolicy, Needs, lost, needs
from jbrep.evaluation.evaluation import (
    EVALUATION,
    KEPT,
    Diagnostics,
    Evaluation,
    Judged,
    JudgedOn,
    measured,
)
from jbrep.evaluation.evaluation import SCALARS as SCALARS
from jbrep.evaluation.held_out import HeldOut
from jbrep.evaluation.prediction import prediction, problems
from jbrep.evaluation.reconstruction import reconstruction
from jbrep.evaluation.regression import Networks, beside, fit
from jbrep.machine import cores
from jbrep.progress import Progress
from jbrep.records.document import read_document
from jbrep.records.storage import exclusive, exists, make_folder
from jbrep.stats.bootstrap import RESAMPLES
from jbrep.training.trainer import single_thread


def write(
    encoders: Mapping[str, Any],
    data: ScaledDataset,
    folder: Path,
    policy: GoodPolicy | None = None,
    truth: Dataset | None = None,
) -> Evaluation:
    """Judge encoders as `diagnose`, and write evaluation.json into a folder, made if needed.

    It replaces an evaluation of the same encoders on the same data, but no other.
    """
    path = folder / EVALUATION
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    make_folder(folder, (EVALUATION,))
    with exclusive(path, beside=True):
        if exists(path):
            there = read_document(path, Evaluation)
            known = there.data.fingerprint, there.data.truth, there.hashes, there.policy
            on = data.dataset.fingerprint, truth.fingerprint if truth else UNSET
            if known != (*on, _hashes(judged), policy.name if policy else None):
                other = f"{path} is not an evaluation of these encoders on this data"
                raise InputError(f"{other}: choose another `out`")
        evaluation = diagnose(judged, data, policy, truth)
        evaluation.write(path)
    return evaluation


def diagnose(
    encoders: Mapping[str, Any],
    data: ScaledDataset | Dataset | str | Path,
    policy: GoodPolicy | None = None,
    truth: Dataset | None = None,
) -> Evaluation:
    """Every diagnostic of every encoder; docs/diagnostics.md describes each.

    Of encoders by label, as `find` takes each; the other parameters are those of `jbrep.evaluate`.
    """
    data = ScaledDataset.of(data)
    held_out = HeldOut(data, truth)
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    if FULL in judged:
        raise InputError(f"the label {FULL} is reserved for the observation itself: choose another")
    header = EncoderHeader(kind=FULL, name=FULL, environment=data.task)
    full = Encoder(header, data.scaler, (), ())
    results, needed = _side_by_side({FULL: full, **judged}, held_out, policy)
    sha256 = _hashes(judged)
    return Evaluation(
        data=_judged_on(held_out),
        resamples=RESAMPLES,
        seen={label: seen(encoder, data) for label, encoder in judged.items()},
        policy=policy.name if policy else None,
        needs=needed,
        encoders={name: each.replace(sha256=sha256.get(name)) for name, each in results.items()},
    )


def _hashes(encoders: Mapping[str, BaseEncoder]) -> dict[str, str]:
    return {label: encoder.fingerprint for label, encoder in encoders.items()}


def _side_by_side(
    encoders: Mapping[str, BaseEncoder], held_out: HeldOut, policy: GoodPolicy | None
) -> tuple[dict[str, Diagnostics], dict[str, float]]:
    """What is said of each encoder, as many at a time as there are cores, and what is needed.

    What is needed is found first, from the full observation, whose networks serve both.
    """
    full = encoders[FULL]

    def begin() -> tuple[Networks, Needs]:
        learnt = networks(full, held_out, policy)
        return learnt, needs(full, held_out, policy, learnt)

    with single_thread(), ThreadPoolExecutor(cores()) as pool:
        begun = pool.submit(begin)

        def judge(label: str) -> Diagnostics:
            encoder = encoders[label]
            _check_finite(label, encoder, held_out.data)
            is_full = encoder is full
            learnt = begun.result()[0] if is_full else networks(encoder, held_out, policy)
            read = readout.probes(encoder, held_out, learnt.probe)
            known = Diagnostics(
                kind=encoder.kind,
                latent=encoder.latent_size,
                scores={},
                prediction={},
                loses=(),
                nonlinear_probes=read,
                reconstruction=reconstruction(encoder, held_out) if encoder.can_decode else None,
                latent_units=readout.latent_units(encoder, held_out),
                method=_method(encoder),
            )
            needed = begun.result()[1]  # waits for it
            ahead = prediction(encoder, held_out, learnt.forward, needed.reward)
            known = known.replace(prediction=ahead, loses=lost(needed.controller, read))
            scores = measured(Judged(encoder, held_out, policy, learnt, known))
            progress.update()
            return known.replace(scores=scores)

        with Progress(total=len(encoders), unit="encoder") as progress:
            futures = {label: pool.submit(judge, label) for label in reversed([*encoders])}
            try:
                results = {label: futures[label].result() for label in encoders}
                return results, begun.result()[1].controller
            finally:
                pool.shutdown(cancel_futures=True)


def _method(encoder: BaseEncoder) -> dict[str, Any]:
    if not isinstance(encoder, Encoder):
        return {}
    return encoder.header.metrics | ({KEPT: len(encoder.kept)} if encoder.kept else {})


def networks(encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy | None = None) -> Networks:
    """All that diagnostics learn from an encoder's latents.

    Fitted at once: one after the other they would take nearly twice as long.
    """
    ahead, probed = problems(encoder, held_out), readout.probe_problem(encoder, held_out)
    of_policy = control.problems(encoder, held_out, policy) if policy else {}
    fitted = iter(fit([*chain.from_iterable(ahead.values()), probed, *of_policy.values()]))
    forward = {steps: beside(next(fitted), next(fitted)) for steps in ahead}
    return Networks(forward, next(fitted), dict(zip(of_policy, fitted, strict=True)))


def _check_finite(label: str, encoder: BaseEncoder, data: ScaledDataset) -> None:
    for rows in chain(data.observations(data.test), data.observations(data.train)):
        with np.errstate(over="ignore", invalid="ignore"):
            latent = encoder.encode(rows)
            back = encoder.decode(latent) if encoder.can_decode else latent
        if not np.isfinite(back).all():
            raise InputError(f"{label} gives numbers that are not finite: train it again")


def seen(encoder: BaseEncoder, data: ScaledDataset) -> Literal["no test row", "none", "maybe"]:
    """Which of these rows an encoder saw in training."""
    source = encoder.header.data if isinstance(encoder, Encoder) else {}
    if not source and encoder.kind in UNLEARNED:
        return "none"
    manifest = data.dataset.manifest
    if source.get("fingerprint") == data.dataset.fingerprint:
        return "no test row"
    policy = source.get("policy")
    kinds = [manifest.settings.policy["kind"]]
    kinds += [policy.get("kind")] if isinstance(policy, Mapping) else []
    if "seed" not in source or IMPORTED in kinds:
        return "maybe"
    return "none" if source["seed"] != manifest.settings.seed else "maybe"


def _judged_on(held_out: HeldOut) -> JudgedOn:
    data, manifest = held_out.data, held_out.data.dataset.manifest
    return JudgedOn(
        task=data.task.name,
        fingerprint=data.dataset.fingerprint,
        policy=dict(manifest.settings.policy),
        seed=manifest.settings.seed,
        train_rows=len(data.train),
        test_rows=len(data.test),
        test_episodes=len(held_out.numbers),
        constant_features=data.constant_features,
        truth=held_out.shown.fingerprint if held_out.shown else UNSET,
        hidden=held_out.hidden or UNSET,
    )
