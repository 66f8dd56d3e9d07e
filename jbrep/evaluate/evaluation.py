"""Encoders side by side on the held-out part of a data set."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.dataset.settings import IMPORTED
from jbrep.encoders import FULL, Encoder, find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import IDENTITY
from jbrep.errors import InputError
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.latent import latent
from jbrep.evaluate.need import Needs, lost, needs
from jbrep.evaluate.networks import Networks, networks
from jbrep.evaluate.policy import GoodPolicy, action, value
from jbrep.evaluate.prediction import prediction
from jbrep.evaluate.readout import correlation, dynamics, neighbours, nonlinear_probes, probes
from jbrep.evaluate.reconstruction import corruption, reconstruction
from jbrep.progress import Progress
from jbrep.stats.bootstrap import RESAMPLES
from jbrep.training.trainer import single_torch_thread

FORMAT = "jbrep evaluation"
FORMAT_VERSION = 2
_Diagnostic = Callable[[BaseEncoder, HeldOut], Any]
_DIAGNOSTICS: dict[str, _Diagnostic] = {
    "reconstruction": reconstruction,
    "corruption": corruption,
    "latent_units": latent,
    "probes": probes,
    "neighbours": neighbours,
    "correlation": correlation,
    "dynamics": dynamics,
}
_DECODING = ("reconstruction", "corruption")  # None of an encoder that doesn't decode


def diagnose(
    encoders: Mapping[str, Any], data: ScaledDataset, policy: GoodPolicy | None = None
) -> dict[str, Any]:
    """Every diagnostic of every encoder, as plain JSON; docs/encoders.md describes each.

    The full observation comes first, as the upper limit of what can be kept. A value with an
    interval is [value, low, high], a 95 % bootstrap interval over episodes. Errors are those of
    features scaled by this data set's extrema, whatever the encoder's own scaling. What needs
    decoding is None for an encoder that can't decode.

    Args:
        encoders: by the label to show; whatever `jbrep.encoders.find` takes, such as a torch
            module.
        data: to judge them on; encoders that were trained on this data set haven't seen its test
            part.
        policy: that does the task well; what encoders say of its actions and its value is None
            without one.

    Raises:
        InputError: an encoder made for other features, or whose numbers overflow; or as `find`.
    """
    held_out = HeldOut(data)
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    for label, encoder in judged.items():
        _check(label, encoder, data)
    full = Encoder({"kind": IDENTITY, "name": FULL}, data.scaler, (), ())
    everything: dict[str, BaseEncoder] = {FULL: full, **judged}
    results, needed = _side_by_side(everything, held_out, policy)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "data": _describe(held_out),
        "resamples": RESAMPLES,
        "seen": {label: seen(encoder, data) for label, encoder in judged.items()},
        "policy": policy and policy.name,
        "needs": needed,
        "encoders": results,
    }


def _side_by_side(
    encoders: Mapping[str, BaseEncoder], held_out: HeldOut, policy: GoodPolicy | None
) -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """What is said of each encoder, as many at a time as there are cores, and what is needed.

    What is needed comes first, the full observation last: they share its networks.
    """
    with single_torch_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
        needed = pool.submit(needs, encoders[FULL], held_out, policy)
        diagnostics = _diagnostics(policy, needed)
        with Progress(total=len(encoders) * len(diagnostics), unit="diagnostic") as progress:

            def judge(label: str) -> dict[str, Any]:
                encoder = encoders[label]
                told: dict[str, Any] = {"kind": encoder.kind, "latent": encoder.latent_size}
                for name, diagnostic in diagnostics.items():
                    progress.set_description_str(f"{label} {name.replace('_', ' ')}", refresh=False)
                    possible = encoder.can_decode or name not in _DECODING
                    told[name] = diagnostic(encoder, held_out) if possible else None
                    progress.update()
                loses = lost(needed.result().controller, told["nonlinear_probes"])
                return {**told, "loses": loses, "method": _made(encoder)}

            futures = {label: pool.submit(judge, label) for label in reversed([*encoders])}
            try:
                results = {label: futures[label].result() for label in encoders}
                return results, needed.result().controller
            finally:
                pool.shutdown(cancel_futures=True)
                networks.cache_clear()  # it holds the data set


def _diagnostics(policy: GoodPolicy | None, needed: Future[Needs]) -> dict[str, _Diagnostic]:
    """All of them by name; those of a policy give None where nothing was learnt of it.

    What has to wait for what is needed comes last.
    """

    def learnt(encoder: BaseEncoder, held_out: HeldOut) -> Networks:
        return networks(encoder, held_out, policy)

    def controlled(encoder: BaseEncoder, held_out: HeldOut) -> dict[str, Any]:
        forward = learnt(encoder, held_out).forward
        return prediction(encoder, held_out, forward, needed.result().reward)

    def of_policy(name: str, judge: Callable[..., Any]) -> _Diagnostic:
        def judged(encoder: BaseEncoder, held_out: HeldOut) -> Any:
            predict = learnt(encoder, held_out).of_policy.get(name)
            return predict and judge(encoder, held_out, policy, predict)

        return judged

    return {
        "nonlinear_probes": lambda e, data: nonlinear_probes(e, data, learnt(e, data).probe),
        **_DIAGNOSTICS,
        "value": of_policy("value", value),
        "action": of_policy("action", action),
        "prediction": controlled,
    }


def _made(encoder: BaseEncoder) -> dict[str, Any]:
    """What the method says of its own fit, such as its spectrum."""
    return dict(encoder.header.get("metrics", {})) if isinstance(encoder, Encoder) else {}


def _check(label: str, encoder: BaseEncoder, data: ScaledDataset) -> None:
    if label == FULL:
        raise InputError(f"the label {FULL} is reserved for the observation itself: choose another")
    rows = data.dataset["observation"][sample(data.test, 1000)]
    with np.errstate(over="ignore", invalid="ignore"):
        latent = encoder.encode(rows)
        back = encoder.decode(latent) if encoder.can_decode else latent
    if not np.isfinite(back).all():
        raise InputError(f"{label} gives numbers that are not finite: train it again")


def seen(encoder: BaseEncoder, data: ScaledDataset) -> str:
    """Which of these rows an encoder saw in training: "no test row", "none" or "maybe"."""
    source = encoder.header["data"] if isinstance(encoder, Encoder) else {}
    manifest = data.dataset.manifest
    if source.get("fingerprint") == manifest.fingerprint:
        return "no test row"
    kinds = {source.get("policy", {}).get("kind"), manifest.settings.policy["kind"]}
    if "seed" not in source or IMPORTED in kinds:
        return "maybe"
    return "none" if source["seed"] != manifest.settings.seed else "maybe"


def _describe(held_out: HeldOut) -> dict[str, Any]:
    data = held_out.data
    return {
        "task": data.task.name,
        "fingerprint": data.dataset.manifest.fingerprint,
        "policy": dict(data.dataset.manifest.settings.policy),
        "seed": data.dataset.manifest.settings.seed,
        "train_rows": len(data.train),
        "test_rows": len(data.test),
        "test_episodes": len(held_out),
        "constant_features": list(data.constant_features),
    }
