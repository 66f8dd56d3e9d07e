"""An encoder's card: what it is, where it comes from, what it reads."""

from collections.abc import Mapping
from typing import Any

from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import Encoder, Layers
from jbrep.text import facts, table

_RECORDS = ("training", "data", "metrics", "versions")


def describe(encoder: BaseEncoder, source: str) -> dict[str, Any]:
    """An encoder's card as plain JSON, with its source, as `source_of` says it."""
    task = encoder.task
    told = {
        "name": encoder.name,
        "source": source,
        "task": task.name,
        "environment": task.id,
        "arguments": dict(task.arguments),
        "kind": encoder.kind,
        "size": encoder.size,
        "latent_size": encoder.latent_size,
    }
    if not isinstance(encoder, Encoder):
        return {**told, "decodes": encoder.can_decode, "sha256": encoder.fingerprint}
    features = encoder.scaler.features(encoder.task)
    ranges = zip(features, encoder.scaler.low, encoder.scaler.high, strict=True)
    return {
        **told,
        "encoder": _layers(encoder.encoder),
        "decoder": _layers(encoder.decoder),
        **{name: getattr(encoder.header, name) for name in _RECORDS},
        "sha256": encoder.fingerprint,
        "features": [
            {"name": feature.name, "unit": feature.unit, "low": float(low), "high": float(high)}
            for feature, low, high in ranges
        ],
    }


def card(encoder: BaseEncoder, source: str, width: int) -> str:
    """The same in lines; of a file, also the range of each feature, scaled to [-1, 1]."""
    told = describe(encoder, source)
    features = told.pop("features", ())
    for part in ("encoder", "decoder"):
        if part in told:
            layers = (f"{layer['units']} {layer['activation']}" for layer in told[part])
            told[part] = " -> ".join(layers) or "none"
    named = {name: _said(value) for name, value in told.items() if value not in ({}, encoder.name)}
    text = f"{encoder.name}\n{facts(named, width)}"
    rows = [(f["name"], f["unit"], f"{f['low']:.4g}", f"{f['high']:.4g}") for f in features]
    return f"{text}\n\n{table(('feature', 'unit', 'low', 'high'), rows)}" if rows else text


def _layers(layers: Layers) -> list[dict[str, Any]]:
    return [{"units": layer.units, "activation": layer.activation} for layer in layers]


def _said(value: Any) -> str:
    """As latent 8, policy (kind uniform)."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, Mapping):
        return str(value)
    parts = (
        f"{n} ({_said(v)})" if isinstance(v, Mapping) else f"{n} {v}" for n, v in value.items()
    )
    return ", ".join(parts)
