"""A data set in other tools' formats: Minari, Parquet, npz."""

import json
import os
import shutil
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset import Dataset
from jbrep.errors import InputError, choose
from jbrep.files.storage import check_space
from jbrep.progress import Progress

_MINARI_FOLDER = "MINARI_DATASETS_PATH"


def export(dataset: Dataset, to: str, out: Path) -> str:
    """Write a data set in another format.

    Args:
        dataset: what to write.
        to: a key of `FORMATS`.
        out: a new file; for Minari, a folder of Minari data sets, new or not.

    Returns:
        How to open it.

    Raises:
        InputError: an unknown format, no rows, something there already, or it can't be written.
    """
    write = choose(to, FORMATS, "format")
    if not len(dataset):
        raise InputError(f"{dataset.folder} has no rows yet")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_space(out.parent, len(dataset) * dataset.manifest.settings.row_bytes())
        return write(dataset, out)
    except (OSError, RuntimeError) as error:  # HDF5 ends in the latter where space runs out
        reason = getattr(error, "strerror", None) or error  # some have only a text
        raise InputError(f"can't write {out}: {reason}") from error


def _to_npz(dataset: Dataset, out: Path) -> str:
    """All columns as arrays in one uncompressed zip, streamed."""
    with _new_file(out) as partial, zipfile.ZipFile(partial, "w", allowZip64=True) as archive:
        for name in Progress(dataset.columns, unit="column", desc=out.name):
            column = dataset[name]
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                header = {"descr": column.dtype.str, "fortran_order": False, "shape": column.shape}
                np.lib.format.write_array_header_1_0(file, header)
                for chunk in column.chunks():
                    file.write(np.ascontiguousarray(chunk).data)
        arrays = {f"episodes/{name}": values for name, values in dataset.episodes.items()}
        arrays["feature_names"] = np.array(dataset.task.feature_names)
        arrays["feature_units"] = np.array([feature.unit for feature in dataset.task.features])
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    return f"numpy.load({str(out)!r})"


def _to_parquet(dataset: Dataset, out: Path) -> str:
    """A row for each control step, a column for each feature; settings in the metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    episodes = out.with_stem(f"{out.stem}-episodes")
    schema = pa.schema(
        [
            pa.field(name, pa.from_numpy_dtype(dtype), nullable=False, metadata={"unit": unit})
            for name, dtype, unit in _numbers_of_a_row(dataset)
        ],
        metadata={"jbrep": json.dumps(asdict(dataset.manifest.settings))},
    )
    coding = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with _new_file(out) as partial, _new_file(episodes) as partial_episodes:
        with pq.ParquetWriter(partial, schema, **coding) as writer:
            chunks = zip(*(dataset[name].chunks() for name in dataset.columns), strict=True)
            for chunk in Progress(chunks, unit="chunk", desc=out.name, leave=False):
                arrays = [column for values in chunk for column in _flat(values)]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        columns = {name: list(values) for name, values in dataset.episodes.items()}
        pq.write_table(pa.table(columns), partial_episodes)
    return f"pandas.read_parquet({str(out)!r}), and {episodes.name} for the episodes"


def _numbers_of_a_row(dataset: Dataset) -> Iterator[tuple[str, np.dtype[Any], str]]:
    """Name, type and unit of each, in the order of the columns."""
    for name in dataset.columns:
        column = dataset[name]
        if name == "observation":
            for feature in dataset.task.features:
                yield feature.name, column.dtype, feature.unit
        elif column.shape[1:] in ((), (1,)):
            yield name, column.dtype, "1"
        else:
            for i in range(column.shape[1]):
                yield f"{name}_{i}", column.dtype, "MuJoCo's"


def _flat(values: NDArray[Any]) -> list[NDArray[Any]]:
    """The columns of (n,) or (n, k)."""
    return list(values.reshape(len(values), -1).T)


def _to_minari(dataset: Dataset, out: Path) -> str:
    """A Minari data set in its HDF5 storage, with the environment that it recovers."""
    import gymnasium
    import minari

    from jbrep.jitterbug.tasks import environment_id

    settings, versions = dataset.manifest.settings, dataset.manifest.versions
    name = f"jitterbug/{settings.task}/{settings.policy['kind']}-v0"
    if (out / name).exists():
        raise InputError(f"{out / name} exists already: choose another folder")
    with _minari_folder(out.resolve()), _whole_folder(out / name), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on the lack of an author's name and address
        minari.create_dataset_from_buffers(
            name,
            _minari_episodes(dataset),
            env=gymnasium.spec(environment_id(settings.task)),
            algorithm_name=settings.policy["kind"],
            description=f"{json.dumps(asdict(settings))} {dataset.manifest.fingerprint}",
            requirements=[f"{package}=={versions[package]}" for package in ("jbrep", "mujoco")],
        )
    return f"{_MINARI_FOLDER}={out} and minari.load_dataset({name!r})"


@contextmanager
def _minari_folder(out: Path) -> Iterator[None]:
    """Minari takes the folder of its data sets from the environment only."""
    before = os.environ.get(_MINARI_FOLDER)
    os.environ[_MINARI_FOLDER] = str(out)
    try:
        yield
    finally:
        del os.environ[_MINARI_FOLDER]
        if before is not None:
            os.environ[_MINARI_FOLDER] = before


@contextmanager
def _whole_folder(path: Path) -> Iterator[None]:
    """Leave nothing behind if it isn't finished."""
    try:
        yield
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise


def _minari_episodes(dataset: Dataset) -> Iterator[Any]:
    from minari.data_collector import EpisodeBuffer

    own, start = dataset.episodes, 0
    for i, length in enumerate(Progress(own["length"], unit="episode", desc="minari")):
        rows, start = slice(start, start + length), start + length
        if not length:
            continue  # it diverged in its first step: Minari has no episodes without steps
        last = np.arange(length) == length - 1
        yield EpisodeBuffer(
            seed=int(own["seed"][i]),
            observations=np.append(
                dataset["observation"][rows], own["final_observation"][i : i + 1], axis=0
            ),
            actions=dataset["action"][rows],
            rewards=dataset["reward"][rows].astype(np.float64),
            terminations=np.zeros(length, dtype=bool),
            truncations=last,
            infos={},
        )


@contextmanager
def _new_file(path: Path) -> Iterator[Path]:
    """A temporary name for a file that gets its own name when it is whole."""
    if path.exists():
        raise InputError(f"{path} exists already: choose another name")
    partial = path.with_name(path.name + ".partial")
    partial.unlink(missing_ok=True)  # it may be a link
    try:
        yield partial
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)


FORMATS: dict[str, Callable[[Dataset, Path], str]] = {
    "minari": _to_minari,
    "parquet": _to_parquet,
    "npz": _to_npz,
}
