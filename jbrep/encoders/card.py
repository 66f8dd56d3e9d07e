"""An encoder's card: what it is, where it comes from, what it reads."""

from collections.abc import Mapping
from typing import Any

from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import Encoder, Layers
from jbrep.envs.task import Feature
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
    ranges = zip(_read(encoder), encoder.scaler.low, encoder.scaler.high, strict=True)
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
    """A few lines on an encoder; of a file, also the range of each feature, scaled to [-1, 1]."""
    told = describe(encoder, source)
    lines = {
        "source": source,
        "task": f"{told['task']}, {told['size']} features to {told['latent_size']}",
        "environment": ", ".join([encoder.task.id, *encoder.task.given_arguments]),
        "kind": told["kind"],
    }
    if not isinstance(encoder, Encoder):
        decodes = "yes" if encoder.can_decode else "no"
        return f"{encoder.name}\n{facts({**lines, 'decodes': decodes}, width)}"
    if coordinates := encoder.scaler.coordinates:
        lines["encodes"] = f"{len(coordinates)} coordinates of the features"
    lines |= {
        "encoder": _shape(encoder.scaler.size, told["encoder"]),
        "decoder": _shape(encoder.latent_size, told["decoder"]) if encoder.can_decode else "none",
        **{name: _listed(told[name]) for name in _RECORDS if told[name]},
        "sha256": told["sha256"],
    }
    rows = [
        (str(feature), f"{f['low']:.4g}", f"{f['high']:.4g}")
        for feature, f in zip(_read(encoder), told["features"], strict=True)
    ]
    return f"{encoder.name}\n{facts(lines, width)}\n\n{table(('feature', 'low', 'high'), rows)}"


def _read(encoder: Encoder) -> tuple[Feature, ...]:
    return encoder.scaler.features(encoder.task)


def _layers(layers: Layers) -> list[dict[str, Any]]:
    return [{"units": layer.units, "activation": layer.activation} for layer in layers]


def _shape(size: int, layers: list[dict[str, Any]]) -> str:
    """As 16 -> 128 relu -> 8 tanh."""
    return " -> ".join(
        [str(size), *(f"{layer['units']} {layer['activation']}" for layer in layers)]
    )


def _listed(record: Mapping[str, Any]) -> str:
    """As latent 8, policy (kind uniform)."""
    return ", ".join(f"{name} {_said(value)}" for name, value in record.items()) or "none"


def _said(value: Any) -> str:
    return f"({_listed(value)})" if isinstance(value, Mapping) else str(value)
