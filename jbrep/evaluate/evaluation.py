"""Encoders side by side on the held-out part of a data set."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.encoders import FULL, Encoder
from jbrep.errors import InputError
from jbrep.evaluate.held_out import HeldOut
from jbrep.evaluate.latent import latent
from jbrep.evaluate.readout import correlation, dynamics, neighbours, probes
from jbrep.evaluate.reconstruction import corruption, reconstruction
from jbrep.progress import Progress
from jbrep.stats.bootstrap import RESAMPLES

FORMAT = "jbrep evaluation"
FORMAT_VERSION = 1
_DIAGNOSTICS: dict[str, Callable[[Encoder, HeldOut], Any]] = {
    "reconstruction": reconstruction,
    "corruption": corruption,
    "latent_units": latent,
    "probes": probes,
    "neighbours": neighbours,
    "correlation": correlation,
    "dynamics": dynamics,
}


def evaluate(encoders: Mapping[str, Encoder], data: ScaledDataset) -> dict[str, Any]:
    """Every diagnostic of every encoder, as plain JSON; docs/encoders.md says what each is.

    The full observation, scaled, comes first, as what there is to keep. A value with an interval
    is [value, low, high], a 95 % bootstrap interval over episodes.

    Args:
        encoders: by the label to show.
        data: to judge them on; its test part is what they haven't seen if they were trained on
            this data set.

    Raises:
        InputError: an encoder made for other features, or whose numbers overflow.
    """
    held_out = HeldOut(data)
    for label, encoder in encoders.items():
        _check(label, encoder, data)
    full = Encoder({"kind": "identity", "name": FULL}, data.scaler, (), ())
    found = {}
    everything = {FULL: full, **encoders}
    with Progress(total=len(everything) * len(_DIAGNOSTICS), unit="diagnostic") as progress:
        for label, encoder in everything.items():
            found[label] = {"kind": encoder.header["kind"], "latent": encoder.latent_size}
            for name, diagnose in _DIAGNOSTICS.items():
                progress.set_description(f"{label} {name}")
                found[label][name] = diagnose(encoder, held_out)
                progress.update()
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "data": _describe(held_out),
        "resamples": RESAMPLES,
        "seen": {label: seen(encoder, data) for label, encoder in encoders.items()},
        "encoders": found,
    }


def _check(label: str, encoder: Encoder, data: ScaledDataset) -> None:
    if label == FULL:
        raise InputError(f"the label {FULL} is that of the observation itself: take another")
    encoder.check_task(data.task)
    rows = data.dataset["observation"][sample(data.test, 1000)]
    with np.errstate(over="ignore", invalid="ignore"):
        back = encoder.decode(encoder.encode(rows))
    if not np.isfinite(back).all():
        raise InputError(f"{label} gives numbers that aren't finite: train it anew")


def seen(encoder: Encoder, data: ScaledDataset) -> str:
    """Whether the encoder was trained on this data set: "no test row", "none" or "maybe"."""
    source, manifest = encoder.header["data"], data.dataset.manifest
    if source.get("fingerprint") == manifest.fingerprint:
        return "no test row"
    apart = "seed" in source and source["seed"] != manifest.settings.seed
    return "none" if apart else "maybe"


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
