"""An encoder as its card: what it is, where it comes from, what it reads."""

from jbrep.encoders.encoder import Encoder, Layer
from jbrep.encoders.file import fingerprint


def card(encoder: Encoder) -> str:
    """A few lines on an encoder, then its features with the range that is scaled to [-1, 1]."""
    header = encoder.header
    facts = {
        "task": f"{header['task']}, {encoder.size} features to {encoder.latent_size}",
        "kind": header["kind"],
        "encoder": _shape(encoder.size, encoder.encoder),
        "decoder": _shape(encoder.latent_size, encoder.decoder),
        "training": _listed(header["training"]),
        "data": _listed(header["data"]),
        "metrics": _listed(header["metrics"]),
        "made with": _listed(header["versions"]),
        "sha256": fingerprint(encoder),
    }
    lines = [encoder.name, *(f"  {name:<10} {value}" for name, value in facts.items()), ""]
    lines.append(f"  {'feature':<28} {'low':>11} {'high':>11}")
    for name, low, high in zip(
        encoder.feature_names, encoder.scaler.low, encoder.scaler.high, strict=True
    ):
        lines.append(f"  {name:<28} {low:11.4g} {high:11.4g}")
    return "\n".join(lines)


def _shape(size: int, layers: tuple[Layer, ...]) -> str:
    """As 16 -> 128 relu -> 8 tanh."""
    return " -> ".join([str(size), *(f"{len(layer.bias)} {layer.activation}" for layer in layers)])


def _listed(record: dict[str, object]) -> str:
    return ", ".join(f"{name} {value}" for name, value in record.items()) or "none"
