"""Encoders that differ in latent size only, which figures draw alike."""

from collections.abc import Iterable, Mapping

from jbrep.encoders import FULL
from jbrep.encoders.names import EncoderName
from jbrep.evaluate.evaluation import Diagnostics
from jbrep.report.figures.style import Styles, styles

Encoders = Mapping[str, Diagnostics]  # of an evaluation, by label

_LINES = ("-", "--", ":", "-.")  # from the largest latent to the smallest


def family(label: str, latent: int) -> str:
    """The label without the latent size, where it ends with that: dae of dae-8, dae-s2 of dae-8-s2.

    Args:
        label: of an encoder.
        latent: its size.
    """
    name = EncoderName.parse(label)
    return str(name._replace(latent=None)) if name.latent == latent else label


def family_styles(families: Iterable[str]) -> Styles:
    """Colour and marker of each family, denoising autoencoders first, the full one's that of text.

    Args:
        families: names, with repeats or without.
    """
    names = sorted(set(families), key=lambda name: (not name.startswith("dae"), name))
    return styles(names, FULL if FULL in names else None)


def line_styles(encoders: Encoders) -> Styles:
    """Of each encoder: colour and marker of its family, and a line that says its latent size."""
    families = {label: family(label, e.latent) for label, e in encoders.items()}
    look = family_styles(families.values())
    sizes: dict[str, list[int]] = {}
    for label, e in encoders.items():
        sizes.setdefault(families[label], []).append(e.latent)
    return {
        label: {
            **look[families[label]],
            "linestyle": _LINES[
                sorted(sizes[families[label]], reverse=True).index(e.latent) % len(_LINES)
            ],
        }
        for label, e in encoders.items()
    }
