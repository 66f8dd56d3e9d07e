"""What an encoder's file says of the encoder, beside its numbers."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from msgspec import Meta

from jbrep.coordinates import Part
from jbrep.encoders.names import Name
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.document import Document
from jbrep.records.record import Record, from_plain, to_plain

FULL = "full"  # name and kind of the encoder that only scales: the whole observation
IMPORTED = "imported"  # the kind of encoder that was trained elsewhere
HELD_OUT_MSE = "held_out_mse"  # the metric that every encoder has, unless it was trained elsewhere
MAX_MAGNITUDE = 1e12  # of any number, far from where float32 overflows

_Words = tuple[str, ...]
_Steps = Annotated[str, Meta(pattern=r"\A[1-9][0-9]{0,8}\Z")]


class _Told(Record, frozen=True, kw_only=True, forbid_unknown_fields=False):
    """What methods say of their fits, as figures show it; they may say more."""

    spectrum: tuple[float, ...] | None = None
    spectra: Mapping[_Steps, tuple[float, ...]] | None = None  # by lag
    loss_by_horizon: Mapping[_Steps, Mapping[str, float]] | None = None
    loss_by_term: Mapping[str, float] | None = None
    divergence: tuple[float, ...] | None = None  # of each unit
    train_loss: float | None = None
    test_loss: float | None = None


class EncoderHeader(Document, frozen=True):
    """The header of an encoder's file.

    The fields from `coordinates` on follow from the encoder; whoever makes one leaves them out.
    """

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
    encoder: Annotated[_Words, Meta(description="The activation after each layer.")] = ()
    decoder: Annotated[_Words, Meta(description="The same of the decoder.")] = ()

    def check(self) -> None:
        """Check that it is plain JSON, with finite numbers, of features that there are."""
        try:
            json.dumps(to_plain(self), allow_nan=False)
        except (TypeError, ValueError, RecursionError):
            raise InputError("it must be plain JSON, all numbers finite") from None
        from_plain(self.metrics, _Told, "metrics")
        if len(set(self.keep)) < len(self.keep):
            raise InputError("what it keeps must be different features")
