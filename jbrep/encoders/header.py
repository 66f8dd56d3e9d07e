"""What an encoder's file says of it beside its numbers, and names, such as dae-8 or pca-8-s2."""

import json
import re
from typing import Annotated, Any, ClassVar, NamedTuple

from msgspec import Meta

from jbrep.coordinates import Part
from jbrep.encoders.layers import MAX_MAGNITUDE
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import converted, pattern, to_plain

FULL = "full"  # name and kind of the encoder that only scales: the whole observation
IMPORTED = "imported"  # the kind of encoder that was trained elsewhere
HELD_OUT_MSE = "held_out_mse"  # the metric that every encoder has, unless it was trained elsewhere

Name = Annotated[str, pattern(r"^[a-z0-9-]+\Z", "small letters, digits and '-'")]
_NAME = re.compile(r"(?P<stem>.+?)(-(?P<latent>[0-9]{1,9}))?(-s(?P<seed>[0-9]{1,9}))?", re.ASCII)
_Words = tuple[str, ...]


class EncoderHeader(Document, frozen=True):
    """The header of an encoder's file; the fields from `coordinates` on follow from the encoder."""

    format: ClassVar[str] = "jbrep encoder"
    format_version: ClassVar[int] = 5

    kind: Annotated[str, Meta(description="The method that made it, `full` or `imported`.")]
    name: Annotated[Name, Meta(description="What tables call it, such as `dae-8`.")]
    environment: Annotated[
        Task, Meta(description="The task whose observations it reads, see data-format.md.")
    ]
    training: Annotated[
        dict[str, Any], Meta(description="Settings of its method: latent size, epochs, seed.")
    ] = {}
    data: Annotated[
        dict[str, Any],
        Meta(description="Fingerprint, policy and seed of its data set; numbers of rows."),
    ] = {}
    versions: Annotated[dict[str, str], Meta(description="Of the packages that made it.")] = {}
    commits: Annotated[
        dict[str, str],
        Meta(description="Of jbrep and of the working directory; not part of the fingerprint."),
    ] = {}
    metrics: Annotated[
        dict[str, Any],
        Meta(description="`held_out_mse`, on all held-out rows; what its method says of its fit."),
    ] = {}
    coordinates: Annotated[
        tuple[Part, ...],
        Meta(
            description="What is scaled and encoded in place of the features: name, formula, what "
            "it is of, whether it is shown, soft length; see coordinates.md."
        ),
    ] = ()
    clip: Annotated[
        Annotated[float, Meta(ge=1, le=MAX_MAGNITUDE)] | None,
        Meta(description="The limit of scaled values."),
    ] = None
    keep: Annotated[
        _Words,
        Meta(description="Features, or coordinates, that skip the layers and follow the code."),
    ] = ()
    encoder: Annotated[
        _Words, Meta(description="The activation after each layer; `onnx` for a model.")
    ] = ()
    decoder: Annotated[_Words, Meta(description="The same of the decoder.")] = ()

    def check(self) -> None:
        try:
            json.dumps(to_plain(self), allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise InputError("it must be plain JSON, all numbers finite") from None
        if len(set(self.keep)) < len(self.keep):
            raise InputError("what it keeps must be different features")


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
