"""LeRobot data sets, version 3 of their layout: https://github.com/huggingface/lerobot.

A folder of Parquet files with a row for each step, and meta/info.json, which says what is in them.
Images and videos are left out. Version 2.1 has the same columns, a file for each episode.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jbrep.dataset.formats.episodes import label
from jbrep.dataset.formats.parquet import batches_of, check_sizes, reading
from jbrep.dataset.formats.tables import NAMES, PEEKED, Table, width, with_offsets, with_widths
from jbrep.dataset.layout import Layout
from jbrep.dataset.reader import Dataset
from jbrep.dataset.scaling import extrema, mean_and_std
from jbrep.errors import InputError, refusing
from jbrep.progress import Progress
from jbrep.records.storage import publish, read_file, unfinished, write_whole

EPISODE_BYTES = 1 << 10  # in the table of episodes
INFO = "meta/info.json"
_VERSIONS = ("v3", "v2")
_FILE_ROWS = 1 << 20  # of what is written
_CHUNK_FILES = 1000
_IMAGES = ("image", "video")
_OFFSETS = "feature_offsets"  # of jbrep's own
_STATE = "observation.state"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_NUMBERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def open_table(given: str) -> Table:
    """Open a data set by its folder."""
    folder = Path(given)
    info = _info(folder / INFO)
    paths = sorted(folder.glob("data/*/*.parquet"))
    if not paths:
        raise InputError(f"{given} has no data/chunk-*/*.parquet: download it whole")
    rows, schema = 0, None
    for path in paths:
        with reading(path), pq.ParquetFile(path) as file:
            check_sizes(str(path), file.metadata, file.schema_arrow)
            schema = schema or with_widths(file.schema_arrow, next(file.iter_batches(PEEKED), None))
            if lacking := [n for n in schema.names if n not in file.schema_arrow.names]:
                raise InputError(f"{path} has no column {lacking[0]!r}, unlike {paths[0].name}")
            rows += file.metadata.num_rows
    assert schema is not None
    if info["frames"] not in (None, rows):
        raise InputError(
            f"{given} has {rows:,} rows, and {INFO} says {info['frames']:,}: download it whole"
        )
    known = info["features"]
    schema = _named(schema, known)
    if (offsets := info["offsets"]).ndim and _STATE in schema.names:
        size = width(schema.field(_STATE).type) or 1
        if offsets.shape != (size,) or not np.isfinite(offsets).all():
            raise InputError(f"{given}: {_OFFSETS} in {INFO} must be {size} numbers")
        schema = with_offsets(schema, _STATE, offsets.tolist())
    images = [name for name, each in known.items() if each["dtype"] in _IMAGES]
    seen = [n for n in known if n.startswith("observation.") and n not in images]
    return Table(
        given,
        label(folder.resolve().name),
        schema,
        lambda columns: _batches(paths, columns),
        rows=rows,
        layout=Layout(observations=tuple(seen), actions=("action",)),
        timestep=1 / info["fps"],
        notes=(f"images are left out: {', '.join(images)}",) if images else (),
    )


def _info(path: Path) -> dict[str, Any]:
    """What the data set says of itself, as far as it is used."""
    raw = read_file(path)
    errors = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
    with refusing(f"{path} isn't as LeRobot writes it", errors):
        info = json.loads(raw)
        version, fps = str(info["codebase_version"]), float(info["fps"])
        frames = int(info["total_frames"]) if "total_frames" in info else None
        known = {str(name): dict(each) for name, each in info["features"].items()}
        known = {name: each | {"dtype": str(each["dtype"])} for name, each in known.items()}
        offsets = np.array(info.get(_OFFSETS, 0.0), np.float64)
    if not version.startswith(_VERSIONS):
        raise InputError(f"{path} is of LeRobot's layout {version}: it must be v3.0 or v2.1")
    if not 0 < fps < np.inf:
        raise InputError(f"{path} has {fps} frames a second")
    return {"fps": fps, "frames": frames, "features": known, "offsets": offsets}


def _named(schema: pa.Schema, known: Mapping[str, Any]) -> pa.Schema:
    """The schema with the names of the numbers in lists."""
    for i, each in enumerate(schema):
        names = known.get(each.name, {}).get("names")
        if isinstance(names, dict):  # as in {"motors": [...]}
            names = next(iter(names.values()), None)
        fits = isinstance(names, list) and len(names) == (width(each.type) or 1)
        if fits and all(isinstance(name, str) for name in names):
            lines = "\n".join(names).encode(errors="replace")
            schema = schema.set(i, each.with_metadata({NAMES: lines}))
    return schema


def _batches(paths: list[Path], columns: list[str]) -> Iterator[pa.RecordBatch]:
    for path in paths:
        yield from batches_of(path, columns)


def write(dataset: Dataset, out: Path) -> str:
    """Write a folder; returns how to open it.

    LeRobot has no place for the observation after the last action, and none for the two ways in
    which an episode ends: what is exported lacks them.
    """
    fps = 1 / dataset.task.known_timestep
    with unfinished(out) as partial:
        fps = round(fps) if abs(fps - round(fps)) < 1e-6 * fps else fps
        (partial / "meta").mkdir(parents=True)
        files = _write_steps(dataset, partial, fps)
        _write_meta(dataset, partial, files, fps)
        publish(partial, out)
    return f"LeRobotDataset({out.name!r}, root={str(out)!r})"


def _features(dataset: Dataset) -> dict[str, Any]:
    task = dataset.task
    actions = [f"action_{i}" for i in range(task.action_size)]
    wide = {_STATE: list(task.feature_names), "action": actions}
    features = {n: {"dtype": "float32", "shape": [len(v)], "names": v} for n, v in wide.items()}
    single = {"next.reward": "float32"} if "reward" in dataset.columns else {}
    single |= {name: "float32" if name == "timestamp" else "int64" for name in _NUMBERS}
    return features | {n: {"dtype": t, "shape": [1], "names": None} for n, t in single.items()}


def _write_steps(dataset: Dataset, folder: Path, fps: float) -> list[int]:
    """The rows, in files of whole episodes; returns the number of the file of each episode."""
    lengths, files, rows = dataset.episodes["length"].tolist(), list[int](), 0
    for length in lengths:
        rows += length
        files.append(files[-1] if files else 0)
        if rows > _FILE_ROWS and rows > length:
            files[-1], rows = files[-1] + 1, length
    schema = pa.schema(
        pa.field(name, pa.list_(kind, each["shape"][0]) if each["shape"] != [1] else kind)
        for name, each in _features(dataset).items()
        for kind in [pa.float32() if each["dtype"] == "float32" else pa.int64()]
    )
    writer, begin = None, 0
    for number, length in enumerate(Progress(lengths, unit="episode", desc=folder.name)):
        if number == 0 or files[number] != files[number - 1]:
            if writer:
                writer.close()
            chunk, file = divmod(files[number], _CHUNK_FILES)
            path = folder / _DATA.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, schema)
        episode, steps = dataset.episode(number), np.arange(length)
        columns = {"timestamp": steps / fps, "frame_index": steps, "index": begin + steps}
        columns |= {"episode_index": np.full(length, number), "task_index": np.zeros(length)}
        columns |= {"next.reward": episode["reward"]} if "next.reward" in schema.names else {}
        wide = {_STATE: episode["observation"], "action": episode["action"]}
        columns |= {name: values[:, 0] for name, values in wide.items()}  # where it is one number
        arrays = [
            pa.FixedSizeListArray.from_arrays(wide[each.name].ravel(), each.type.list_size)
            if pa.types.is_fixed_size_list(each.type)
            else pa.array(columns[each.name].astype(each.type.to_pandas_dtype()))
            for each in schema
        ]
        assert writer is not None
        writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
        begin += length
    if writer:
        writer.close()
    return files


def _write_meta(dataset: Dataset, folder: Path, files: list[int], fps: float) -> None:
    lengths, name = dataset.episodes["length"], dataset.task.name
    ends, count = np.cumsum(lengths), len(lengths)
    chunks, numbers = np.divmod(files, _CHUNK_FILES)
    episodes = {
        "episode_index": np.arange(count),
        "tasks": [[name]] * count,
        "length": lengths.astype(np.int64),
        "data/chunk_index": chunks,
        "data/file_index": numbers,
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": np.zeros(count, np.int64),
        "meta/episodes/file_index": np.zeros(count, np.int64),
    }
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(pa.table(episodes), path)
    index = "__index_level_0__"  # pandas reads the tasks by their names
    kinds = {"task_index": ("task_index", "int64", "int64"), index: (None, "unicode", "object")}
    keys = ("name", "pandas_type", "numpy_type")
    columns = [
        {"field_name": n, "metadata": None, **dict(zip(keys, k, strict=True))}
        for n, k in kinds.items()
    ]
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns}
    tasks = pa.table({"task_index": [0], index: [name]})
    tasks = tasks.replace_schema_metadata({"pandas": json.dumps({**pandas, "pandas_version": "2"})})
    pq.write_table(tasks, folder / "meta/tasks.parquet")
    stats = {}
    for column, of in ((_STATE, "observation"), ("action", "action")):
        (low, high), (mean, std) = extrema(dataset[of].chunks()), mean_and_std(dataset[of].chunks())
        told = {"min": low, "max": high, "mean": mean, "std": std, "count": [len(dataset)]}
        stats[column] = {what: np.asarray(each).tolist() for what, each in told.items()}
    write_whole(folder / "meta/stats.json", json.dumps(stats, indent=4).encode())
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": count,
        "total_frames": len(dataset),
        "total_tasks": 1,
        "chunks_size": _CHUNK_FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{count}"},
        "data_path": _DATA,
        "video_path": None,
        "features": _features(dataset),
        _OFFSETS: dataset.task.offset.tolist(),
    }
    write_whole(folder / INFO, json.dumps(info, indent=4).encode())
