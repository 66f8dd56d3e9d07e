"""Names of encoders: method, variant, latent size and seed, such as dae-8, dae-deep-8, pca-8-s2."""

import re
from typing import Annotated, NamedTuple

from jbrep.records.record import converted, pattern

Name = Annotated[str, pattern(r"^[a-z0-9-]+\Z", "small letters, digits and '-'")]
_NAME = re.compile(r"(?P<stem>.+?)(-(?P<latent>[0-9]{1,9}))?(-s(?P<seed>[0-9]{1,9}))?", re.ASCII)


class EncoderName(NamedTuple):
    """What a name says; `str` makes the name."""

    stem: str  # the method, with what is unusual about it
    latent: int | None = None
    seed: int | None = None  # of one of several trainings

    @classmethod
    def parse(cls, name: str) -> "EncoderName":
        """The parts of any name."""
        match = _NAME.fullmatch(name)
        if not match:
            return cls(name)
        latent, seed = (int(match[part]) if match[part] else None for part in ("latent", "seed"))
        return cls(match["stem"], latent, seed)

    @property
    def order(self) -> tuple[str, int, int]:
        """Sorts names by stem, the largest latent first, then by seed."""
        return self.stem, -(self.latent or 0), self.seed or 0

    def __str__(self) -> str:
        latent = "" if self.latent is None else f"-{self.latent}"
        return f"{self.stem}{latent}" + ("" if self.seed is None else f"-s{self.seed}")


def of_seed(name: str, seed: int) -> str:
    """The name of one of several trainings: dae-8-s2."""
    return str(EncoderName.parse(name)._replace(seed=seed))


def check_name(name: str) -> None:
    """Make sure that an encoder can have a name."""
    converted(name, Name, "the name of an encoder")
