"""Arrays with a row for each step, as frames: those in Python, and those of other files."""

import math
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping
from itertools import accumulate
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.frame import CHUNK, ENDS, About, Frame, check_names, label_of, own_names
from jbrep.envs.task import MAX_FEATURES, Feature
from jbrep.errors import InputError, refusing

_IMAGE_AXES = 3  # height, width, colour


def is_image(array: Any) -> bool:
    """Whether it holds images, or as many numbers in a row."""
    row = array.shape[1:]
    is_picture = len(row) >= _IMAGE_AXES or (len(row) > 1 and array.dtype == np.uint8)
    return is_picture or math.prod(row) > MAX_FEATURES


def frame_of_arrays(name: str, arrays: Mapping[str, Array], **more: Any) -> Frame:
    """Arrays of the steps of all episodes, one after the other; more is of the frame."""
    own = own_names(name, arrays)
    check_lengths(name, {role: arrays[column] for role, column in own.items()})
    rows = len(arrays[own["action"]]) if "action" in own else 0
    columns, unusable = dict[str, pa.Array](), dict[str, str]()
    for column, each in arrays.items():
        if each.dtype.kind not in "fiub" or each.dtype.itemsize > 8:
            unusable[column] = f"of type {each.dtype}, no plain numbers"
        elif is_image(each):
            unusable[column] = "images, or more numbers than features can be"
        elif not each.ndim or len(each) != rows or not math.prod(each.shape[1:]):
            unusable[column] = f"of shape {each.shape}: there must be numbers in {rows:,} rows"
        else:
            columns[column] = column_of(each)

    def batches(names: list[str]) -> Iterator[pa.RecordBatch]:
        whole = pa.RecordBatch.from_arrays([columns[name] for name in names], names=names)
        for begin in range(0, rows, CHUNK):
            yield whole[begin : begin + CHUNK]

    schema = pa.schema([(column, each.type) for column, each in columns.items()])
    about = {"name": name, "rows": rows, "unusable": unusable, **more}
    return Frame(**about, schema=schema, batches=batches)


def frame_of_steps(
    name: str, arrays: Mapping[str, Array], once: Mapping[str, Any], about: About, **more: Any
) -> Frame:
    """The same of arrays that are called as in `ALIASES`.

    What is known once for each of n episodes may be final_observation (n, ...), terminated,
    truncated and seed (n,). Observations are numbered where nothing has their names.
    """
    own = own_names(name, arrays)
    check_names(name, own, arrays)
    for what, column in own.items():
        array_of(name, what, arrays[column])
    known = {what: array_of(name, what, values) for what, values in once.items()}
    check_lengths(name, known, "episodes")
    known |= {what: flat(each) for what, each in known.items() if what != "final_observation"}
    if wide := [w for w, each in known.items() if w != "final_observation" and each.ndim > 1]:
        raise InputError(f"{name} has several {wide[0]}s for each episode: it must be one")
    if "seed" in known and known["seed"].dtype.kind not in "iu":
        raise InputError(f"{name} has seeds of type {known['seed'].dtype}: they must be whole")
    observation, final = own["observation"], known.pop("final_observation", None)
    if final is not None and final.dtype.kind not in "fiub":
        raise InputError(
            f"{name} has final observations of type {final.dtype}: they must be numbers"
        )
    row = arrays[observation].shape[1:]
    if not (about.names or about.features):
        numbers = (Feature(name=f"obs_{i}", group="obs") for i in range(math.prod(row)))
        about = about._replace(features=tuple(numbers))
    more |= {"once": known, "final": {} if final is None else {observation: flat(final)}}
    frame = frame_of_arrays(name, arrays, about={observation: about}, **more)
    if final is not None and final.shape[1:] != row and observation not in frame.unusable:
        raise InputError(f"{name} has final observations of {final.shape[1:]}: it must be {row}")
    return frame


def frame_in_python(columns: Mapping[str, Any], once: Mapping[str, Any], name: str) -> Frame:
    """Arrays in Python, by the keys of `ALIASES`; those that are None aren't there.

    They have a row for each step of all episodes, or are lists with such an array for each episode.
    """
    given = {what: values for what, values in columns.items() if values is not None}
    known = {what: values for what, values in once.items() if values is not None}
    check_names(name, given, given)
    single = next(given[what] for what in ("reward", *ENDS) if what in given)
    observations, more = given["observation"], dict[str, Any](label=label_of(name))
    if isinstance(single, list | tuple) and len(single) and np.ndim(single[0]) == 1:
        check_lengths(name, given, "episodes")
        several = {
            what: [array_of(name, what, each) for each in values] for what, values in given.items()
        }
        parts = [{w: values[i] for w, values in several.items()} for i in range(len(observations))]
        given, more["place"] = joined(name, {f"episode {i}": e for i, e in enumerate(parts)})
        observations = observations[0]
    names = [*getattr(observations, "columns", ())]  # of a data frame
    about = About(names=tuple(names) if all(isinstance(each, str) for each in names) else ())
    arrays = {what: array_of(name, what, values) for what, values in given.items()}
    return frame_of_steps(name, arrays, known, about, **more)


def joined(
    name: str, episodes: Mapping[str, Mapping[str, Array]]
) -> tuple[dict[str, Array], Callable[[int], str]]:
    """The arrays of all episodes, one after the other, and what a row is called by its number.

    Where observations have a row more than actions, what came after each action is known.
    """
    if not episodes:
        raise InputError(f"{name} has no episodes")
    wheres, parts = [*episodes], [_with_next(arrays) for arrays in episodes.values()]
    first, action = parts[0], own_names(name, parts[0])["action"]
    lengths = [len(arrays[action]) for arrays in parts]
    fitting = [column for column, each in first.items() if len(each) == lengths[0]]
    for where, arrays, length in zip(wheres, parts, lengths, strict=True):
        for column in fitting:
            shape = (length, *first[column].shape[1:])
            if (has := getattr(arrays.get(column), "shape", "missing")) != shape:
                raise InputError(
                    f"{name}, {where}: the shape of {column!r} is {has}: expected {shape}, from "
                    "its actions and earlier episodes"
                )
    whole = {column: np.concatenate([arrays[column] for arrays in parts]) for column in fitting}
    ends = [*accumulate(lengths)]

    def place(row: int) -> str:
        i = bisect(ends, row)
        return f"{wheres[i]}, step {row - ends[i] + lengths[i]}"

    return {**first, **whole, "episode": np.repeat(range(len(parts)), lengths)}, place


def _with_next(arrays: Mapping[str, Array]) -> Mapping[str, Array]:
    seen: Any = arrays.get("observation", ())
    is_longer = len(seen) == len(arrays.get("action", ())) + 1
    return (
        {**arrays, "observation": seen[:-1], "next_observation": seen[1:]} if is_longer else arrays
    )


def array_of(name: str, what: str, values: ArrayLike) -> Array:
    """An array with rows."""
    with (
        refusing(f"{name} has {what}s that make no array", (RuntimeError, TypeError)),
        refusing(f"{name} has {what}s of different sizes", (ValueError,)),
    ):
        array = np.asarray(np.ma.filled(values, np.nan) if np.ma.isMaskedArray(values) else values)
    if not array.ndim:
        raise InputError(f"{name} has a single {what}: it must be an array")
    return array


def check_lengths(name: str, arrays: Mapping[str, Any], unit: str = "rows") -> None:
    """Make sure that all are equally long."""
    first, expected = next(((what, len(each)) for what, each in arrays.items()), ("", 0))
    for what, each in arrays.items():
        if len(each) != expected:
            raise InputError(
                f"{name} has {expected:,} {unit} of {first}s, and {len(each):,} of {what}s: the "
                "two must be equal"
            )


def flat(values: Array) -> Array:
    """An array, (n, ...), as (n,) or (n, numbers)."""
    size = math.prod(values.shape[1:])
    return np.ravel(values) if size == 1 else values.reshape(len(values), size)


def column_of(values: Array) -> pa.Array:
    """An array, (n, ...), as a column: numbers, or a list of them in each row."""
    kind, rows = values.dtype.newbyteorder("="), flat(values)
    numbers = pa.array(np.ravel(rows).astype(kind, copy=False))
    return numbers if rows.ndim == 1 else pa.FixedSizeListArray.from_arrays(numbers, rows.shape[1])
