"""Names of encoders: kind, architecture, latent size, such as dae-8, dae-deep-8, dae-64x64-8."""

import re
from typing import NamedTuple

from jbrep.errors import InputError

USUAL_ARCHITECTURE = "paper"  # left out of a name


class EncoderName(NamedTuple):
    """What a name says; `str` makes the name."""

    kind: str
    architecture: str = USUAL_ARCHITECTURE
    latent: int | None = None

    @classmethod
    def parse(cls, name: str) -> "EncoderName":
        """The parts of any name; without a latent size at its end, all of it is the kind."""
        words, _, latent = name.rpartition("-")
        if not (words and latent.isascii() and latent.isdecimal() and len(latent) < 10):
            return cls(name)
        kind, _, architecture = words.partition("-")
        architecture = architecture.replace(",", "x")  # sizes, as a command line takes them
        return cls(kind, architecture or USUAL_ARCHITECTURE, int(latent))

    @property
    def order(self) -> tuple[str, str, int]:
        """Sorts names by kind, then by architecture, the largest latent first."""
        usual = self.architecture == USUAL_ARCHITECTURE
        return self.kind, "" if usual else self.architecture, -(self.latent or 0)

    def __str__(self) -> str:
        usual = self.architecture == USUAL_ARCHITECTURE
        words = (self.kind, "" if usual else self.architecture, str(self.latent or ""))
        return "-".join(word for word in words if word)


def check_name(name: str) -> None:
    """Make sure that an encoder can have a name.

    Raises:
        InputError: it can't.
    """
    if not re.fullmatch("[a-z0-9-]+", name):
        raise InputError(
            f"invalid encoder name {name!r}: use lower-case letters, digits and hyphens"
        )
