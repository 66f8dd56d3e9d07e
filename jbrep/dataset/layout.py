"""What the columns of a table are to a data set, and what becomes of its rows."""

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from jbrep.records.record import Record

_Name = Annotated[str, Meta(min_length=1, max_length=1000)]
_Names = tuple[_Name, ...]
_Seconds = Annotated[float, Meta(gt=0, le=1e9)]


class Layout(Record, frozen=True, kw_only=True):
    """What the columns of a table are, by their names, and what becomes of its rows.

    Observations and actions may be patterns, such as `imu.*`, and columns of lists.
    """

    observations: Annotated[
        _Names,
        Meta(
            description="Columns that make the observation: names or patterns, as in 'hip,imu.*'.",
            extra={"default": "all others"},
        ),
    ] = ()
    actions: Annotated[
        _Names,
        Meta(
            description="Columns that make the action, likewise.",
            extra={"default": "action, or action_0, action_1 and so on"},
        ),
    ] = ()
    reward: Annotated[
        str,
        Meta(
            description="The reward's column; or module:function, which is run, for rewards (n,) "
            "of observations (n, d) and actions (n, k).",
            extra={"default": "reward, if there is one", "is_code": True},
        ),
    ] = ""
    time: Annotated[
        str,
        Meta(description="The column of times: dates, or numbers, in s unless a unit is given."),
    ] = ""
    episode: Annotated[str, Meta(description="A column with each episode's number or word.")] = ""
    terminated: Annotated[
        str,
        Meta(
            description="A column that is true where a state ended the episode; without next "
            "observations it only ends there, truncated."
        ),
    ] = ""
    units: Annotated[
        Mapping[_Name, str],
        Meta(
            description="Units of columns: pitch=deg,t=ms.",
            extra={"default": "as in 'pitch [deg]'"},
        ),
    ] = {}
    angles: Annotated[
        _Names, Meta(description="Observations that are angles, in rad or deg, which may wrap.")
    ] = ()
    gap: Annotated[_Seconds | None, Meta(description="A pause that ends an episode [s].")] = None
    length: Annotated[
        Annotated[int, Meta(ge=2, le=1_000_000)] | None,
        Meta(description="Rows after which an episode is cut."),
    ] = None
    rate: Annotated[
        Annotated[float, Meta(gt=0, le=1e6)] | None,
        Meta(description="Resample the rows to this rate [Hz]."),
    ] = None
    fill: Annotated[
        Literal["latest", "linear"],
        Meta(
            description="What stands between readings then: the latest, or for observations what "
            "lies between two.",
            extra={"default": "latest"},  # in words, as an option that isn't given is none
        ),
    ] = "latest"
