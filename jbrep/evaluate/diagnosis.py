"""Encoders side by side on the held-out part of a data set."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from msgspec import UNSET, UnsetType

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.dataset.settings import IMPORTED
from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import as_file
from jbrep.encoders.header import EncoderHeader
from jbrep.errors import InputError
from jbrep.evaluate import control, prediction, readout
from jbrep.evaluate.control import GoodPolicy, Needs, lost, needs
from jbrep.evaluate.evaluation import EVALUATION, KEPT, Diagnostics, Evaluation, JudgedOn
from jbrep.evaluate.held_out import HeldOut, Rows
from jbrep.evaluate.reconstruction import corruption, reconstruction
from jbrep.evaluate.regression import Networks, beside, fit
from jbrep.machine import cores
from jbrep.progress import Progress
from jbrep.records.document import read_document
from jbrep.records.lock import exclusive
from jbrep.records.storage import exists, make_folder
from jbrep.stats.bootstrap import RESAMPLES
from jbrep.training.trainer import single_thread

_CHECKED = 100_000  # rows at once


def write(
    encoders: Mapping[str, Any],
    data: ScaledDataset,
    folder: Path,
    policy: GoodPolicy | None = None,
    truth: Dataset | None = None,
) -> Evaluation:
    """Judge encoders as `diagnose`, and write evaluation.json into a folder, made if needed."""
    path = folder / EVALUATION
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    make_folder(folder, (EVALUATION,))
    with exclusive(path, beside=True):
        before = _before(path, data, hashes(judged), policy, truth)
        evaluation = diagnose(judged, data, policy, truth)
        if before:
            evaluation = evaluation.replace(worth=before.worth)
        evaluation.write(path)
    return evaluation


def _before(
    path: Path,
    data: ScaledDataset,
    encoders: dict[str, str],
    policy: GoodPolicy | None,
    truth: Dataset | None,
) -> Evaluation | None:
    """The evaluation of the same that a repeated one replaces, if there is one."""
    if not exists(path):
        return None
    on = data.dataset.fingerprint, _fingerprint(truth)
    wanted = *on, encoders, policy.name if policy else None
    there = read_document(path, Evaluation)
    if (there.data.fingerprint, there.data.truth, there.hashes, there.policy) == wanted:
        return there
    raise InputError(
        f"{path} is not an evaluation of these encoders on this data: choose another --out"
    )


def _fingerprint(truth: Dataset | None) -> str | UnsetType:
    return truth.fingerprint if truth else UNSET


def diagnose(
    encoders: Mapping[str, Any],
    data: ScaledDataset | Dataset | str | Path,
    policy: GoodPolicy | None = None,
    truth: Dataset | None = None,
) -> Evaluation:
    """Every diagnostic of every encoder; docs/diagnostics.md describes each.

    The full observation comes first, as the upper limit of what can be kept. Errors are those of
    features scaled by this data set's extrema, whatever the encoder's own scaling.

    Args:
        encoders: by the label to show; whatever `jbrep.encoders.find` takes, such as a torch
            module.
        data: to judge them on; encoders that were trained on this data set haven't seen its test
            part.
        policy: that does the task well; what encoders say of its actions and its value is None
            without one.
        truth: the data set that this was derived from, with features that it hides: how well they
            can be read from a code is among the probes.
    """
    data = ScaledDataset.of(data)
    held_out = HeldOut(data, truth)
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    for label, encoder in judged.items():
        if label == FULL:
            raise InputError(
                f"the label {FULL} is reserved for the observation itself: choose another"
            )
        _check_finite(label, encoder, data, sample(data.test, 1000))
    header = EncoderHeader(kind=FULL, name=FULL, environment=data.task)
    full = Encoder(header, data.scaler, (), ())
    results, needed = _side_by_side({FULL: full, **judged}, held_out, policy)
    sha256 = hashes(judged)
    return Evaluation(
        data=_judged_on(held_out, truth),
        resamples=RESAMPLES,
        seen={label: seen(encoder, data) for label, encoder in judged.items()},
        policy=policy.name if policy else None,
        needs=needed,
        encoders={name: each.replace(sha256=sha256.get(name)) for name, each in results.items()},
    )


def hashes(encoders: Mapping[str, BaseEncoder]) -> dict[str, str]:
    """SHA-256 of encoders by label; of a module, that of the file that a run keeps of it."""
    with single_thread():
        return {label: as_file(encoder).fingerprint for label, encoder in encoders.items()}


def _side_by_side(
    encoders: Mapping[str, BaseEncoder], held_out: HeldOut, policy: GoodPolicy | None
) -> tuple[dict[str, Diagnostics], dict[str, float]]:
    """What is said of each encoder, as many at a time as there are cores, and what is needed.

    What is needed comes first, the full observation last: they share its networks.
    """
    full = encoders[FULL]

    def begin() -> tuple[Networks, Needs]:
        learnt = networks(full, held_out, policy)
        return learnt, needs(full, held_out, policy, learnt)

    with single_thread(), ThreadPoolExecutor(cores()) as pool:
        begun = pool.submit(begin)
        total = len(encoders) * len(_DIAGNOSTICS)
        with Progress(total=total, unit="diagnostic") as progress:

            def judge(label: str) -> Diagnostics:
                encoder, known = encoders[label], dict[str, Any]()
                is_full = encoder is full
                learnt = begun.result()[0] if is_full else networks(encoder, held_out, policy)
                judged = _Judged(encoder, held_out, policy, learnt, begun)
                for name, diagnostic in _DIAGNOSTICS.items():
                    progress.set_description_str(f"{label} {name.replace('_', ' ')}", refresh=False)
                    known[name] = diagnostic(judged)
                    progress.update()
                return Diagnostics(
                    kind=encoder.kind,
                    latent=encoder.latent_size,
                    loses=lost(judged.needs.controller, known["nonlinear_probes"]),
                    method=_of_method(encoder) if isinstance(encoder, Encoder) else {},
                    **known,
                )

            def judge_or_blame(label: str) -> Diagnostics:
                try:
                    return judge(label)
                except (ValueError, np.linalg.LinAlgError):
                    data = held_out.data
                    for rows in (data.train, data.test):
                        _check_finite(label, encoders[label], data, rows)
                    raise

            futures = {label: pool.submit(judge_or_blame, label) for label in reversed([*encoders])}
            try:
                results = {label: futures[label].result() for label in encoders}
                return results, begun.result()[1].controller
            finally:
                pool.shutdown(cancel_futures=True)


def _of_method(encoder: Encoder) -> dict[str, Any]:
    kept = len(encoder.kept)
    return {**encoder.header.metrics, **({KEPT: kept} if kept else {})}


class _Judged(NamedTuple):
    """An encoder with what its diagnostics share."""

    encoder: BaseEncoder
    held_out: HeldOut
    policy: GoodPolicy | None
    learnt: Networks
    begun: "Future[tuple[Networks, Needs]]"

    @property
    def needs(self) -> Needs:
        """What is needed, once that is known."""
        return self.begun.result()[1]


_DIAGNOSTICS: dict[str, Callable[[_Judged], Any]] = {
    "nonlinear_probes": lambda e: readout.nonlinear_probes(e.encoder, e.held_out, e.learnt.probe),
    "reconstruction": lambda e: (
        reconstruction(e.encoder, e.held_out) if e.encoder.can_decode else None
    ),
    "corruption": lambda e: corruption(e.encoder, e.held_out) if e.encoder.can_decode else None,
    "latent_units": lambda e: readout.latent_units(e.encoder, e.held_out),
    "probes": lambda e: readout.probes(e.encoder, e.held_out),
    "neighbours": lambda e: readout.neighbours(e.encoder, e.held_out),
    "correlation": lambda e: readout.correlation(e.encoder, e.held_out),
    "dynamics": lambda e: readout.dynamics(e.encoder, e.held_out),
    "value": lambda e: control.value(e.encoder, e.policy, e.learnt.of_policy),
    "action": lambda e: control.action(e.encoder, e.held_out, e.policy, e.learnt.of_policy),
    "prediction": lambda e: prediction.prediction(  # waits for what is needed
        e.encoder, e.held_out, e.learnt.forward, e.needs.reward
    ),
}


def networks(encoder: BaseEncoder, held_out: HeldOut, policy: GoodPolicy | None = None) -> Networks:
    """All that diagnostics learn from an encoder's latents.

    Fitted at once: one after the other they would take nearly twice as long.
    """
    ahead = prediction.problems(encoder, held_out)
    of_policy = control.problems(encoder, held_out, policy) if policy else {}
    pairs = chain.from_iterable(ahead.values())
    fitted = iter(fit([*pairs, readout.problem(encoder, held_out), *of_policy.values()]))
    forward = {steps: beside(next(fitted), next(fitted)) for steps in ahead}
    return Networks(forward, next(fitted), dict(zip(of_policy, fitted, strict=True)))


def _check_finite(label: str, encoder: BaseEncoder, data: ScaledDataset, rows: Rows) -> None:
    for some in np.array_split(rows, -(-len(rows) // _CHECKED)):
        with np.errstate(over="ignore", invalid="ignore"):
            latent = encoder.encode(data.dataset["observation"][some])
            back = encoder.decode(latent) if encoder.can_decode else latent
        if not np.isfinite(back).all():
            raise InputError(f"{label} gives numbers that are not finite: train it again")


def seen(encoder: BaseEncoder, data: ScaledDataset) -> Literal["no test row", "none", "maybe"]:
    """Which of these rows an encoder saw in training."""
    source = encoder.header.data if isinstance(encoder, Encoder) else {}
    manifest = data.dataset.manifest
    if source.get("fingerprint") == data.dataset.fingerprint:
        return "no test row"
    policy = source.get("policy")
    kinds = [manifest.settings.policy["kind"]]
    kinds += [policy.get("kind")] if isinstance(policy, Mapping) else []
    if "seed" not in source or IMPORTED in kinds:
        return "maybe"
    return "none" if source["seed"] != manifest.settings.seed else "maybe"


def _judged_on(held_out: HeldOut, truth: Dataset | None) -> JudgedOn:
    data, manifest = held_out.data, held_out.data.dataset.manifest
    return JudgedOn(
        task=data.task.name,
        fingerprint=data.dataset.fingerprint,
        policy=dict(manifest.settings.policy),
        seed=manifest.settings.seed,
        train_rows=len(data.train),
        test_rows=len(data.test),
        test_episodes=len(held_out),
        constant_features=data.constant_features,
        truth=_fingerprint(truth),
        hidden=held_out.hidden or UNSET,
    )
