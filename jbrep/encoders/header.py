"""What an encoder's file says of the encoder, beside its numbers."""

import json
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from jbrep.coordinates import Part
from jbrep.encoders.layers import MAX_MAGNITUDE
from jbrep.encoders.names import Name
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import to_plain

FULL = "full"  # name and kind of the encoder that only scales: the whole observation
IMPORTED = "imported"  # the kind of encoder that was trained elsewhere
HELD_OUT_MSE = "held_out_mse"  # the metric that every encoder has, unless it was trained elsewhere

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
        Meta(
            description="Features, or coordinates, that pass around the layers and follow the code."
        ),
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
