"""LeRobot data sets, version 3 of their layout: https://github.com/huggingface/lerobot.

A folder of Parquet files with a row for each step, and meta/info.json, which says what is in them.
Images and videos are left out. Version 2.1 has the same columns, a file for each episode.
"""

import json
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.arrays import column_of
from jbrep.dataset.formats.clock import same_clock, timestep_of
from jbrep.dataset.formats.frame import PEEKED, About, Frame, check_plain, label_of, measured, width
from jbrep.dataset.formats.parquet import batches_of, opened
from jbrep.dataset.layout import Layout
from jbrep.dataset.reader import Dataset
from jbrep.dataset.scaling import extrema, mean_and_std
from jbrep.errors import InputError
from jbrep.progress import Progress
from jbrep.records.storage import publish, unfinished

INFO = "meta/info.json"
_VERSIONS = ("v3", "v2")
_IMAGES = ("image", "video")
_OFFSETS = "feature_offsets"  # of jbrep's own
_STATE = "observation.state"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = f"meta/episodes/{_DATA.removeprefix('data/')}"
_INDEX = "__index_level_0__"  # pandas reads the tasks by their names
_OF_PANDAS = {
    "index_columns": [_INDEX],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": dtype}
        for name, field, kind, dtype in (
            ("task_index", "task_index", "int64", "int64"),
            (None, _INDEX, "unicode", "object"),
        )
    ],
    "pandas_version": "2",
}


def read(given: str) -> Frame:
    """Read a data set by its folder."""
    folder = Path(given)
    check_plain(folder)
    info = folder / INFO
    meta = json.loads(info.read_bytes())
    version, fps = str(meta["codebase_version"]), float(meta["fps"])
    features = {str(name): dict(each) for name, each in meta["features"].items()}
    frames = int(meta["total_frames"]) if "total_frames" in meta else None
    offsets = tuple(float(each) for each in meta.get(_OFFSETS, ()))
    images = [name for name, each in features.items() if each["dtype"] in _IMAGES]
    if not version.startswith(_VERSIONS):
        raise InputError(f"{info} is of LeRobot's layout {version}: it must be v3.0 or v2.1")
    if not 0 < fps < np.inf:
        raise InputError(f"{info} has {fps} frames a second")
    paths = sorted(folder.glob("data/*/*.parquet"))
    if not paths:
        raise InputError(f"{given} has no data/chunk-*/*.parquet: download it whole")
    with opened(paths[0]) as file:
        first = next(file.iter_batches(PEEKED), None)
        schema = measured(file.schema_arrow, first)
    rows = 0
    for path in paths:
        with opened(path) as file:
            rows += file.metadata.num_rows
    if frames not in (None, rows):
        raise InputError(
            f"{given} has {rows:,} rows, and {INFO} says {frames:,}: download it whole"
        )
    about = {each.name: About(names=_names(each, features.get(each.name, {}))) for each in schema}
    if offsets and _STATE in about:
        about[_STATE] = about[_STATE]._replace(offsets=offsets)
    seen = [name for name in features if name.startswith("observation.") and name not in images]
    return Frame(
        name=given,
        label=label_of(folder.resolve().name),
        schema=schema,
        batches=lambda columns: batches_of(paths, columns),
        rows=rows,
        about=about,
        unusable=dict.fromkeys(images, "images"),
        layout=Layout(observations=tuple(seen), actions=("action",)),
        timestep=1 / fps,
        notes=_clock_notes(first, fps),
    )


def _clock_notes(first: pa.RecordBatch | None, fps: float) -> tuple[str, ...]:
    """What to say where the first rows' own times contradict the rate."""
    if first is None or "timestamp" not in first.schema.names:
        return ()
    step = timestep_of(np.diff(np.array(first.column("timestamp"), np.float64)))
    if same_clock(step, 1 / fps):
        return ()
    clocks = f"timestamps are {step:.4g} s apart, and {INFO} says {fps:g} frames a second"
    return (f"{clocks}, which is taken: --time timestamp takes the others",)


def _names(column: pa.Field, feature: dict[str, Any]) -> tuple[str, ...]:
    """The names of the numbers of a column, if they are told."""
    names = feature.get("names")
    if isinstance(names, dict):  # as in {"motors": [...]}
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or len(names) != (width(column.type) or 1):
        return ()
    return tuple(names) if all(isinstance(each, str) for each in names) else ()


def write(dataset: Dataset, out: Path) -> str:
    """Write a folder; returns how to open it.

    LeRobot has no place for the observation after the last action, and none for the two ways in
    which an episode ends: what is exported lacks them.
    """
    fps = 1 / dataset.task.known_timestep
    fps = round(fps) if abs(fps - round(fps)) < 1e-6 * fps else fps
    with unfinished(out) as partial:
        for path in (_DATA, _EPISODES):
            (partial / path.format(chunk_index=0, file_index=0)).parent.mkdir(parents=True)
        _write_steps(dataset, partial / _DATA.format(chunk_index=0, file_index=0), fps)
        _write_meta(dataset, partial, fps)
        publish(partial, out)
    return f"LeRobotDataset({out.name!r}, root={str(out)!r})"


def _columns(dataset: Dataset, begin: int, end: int, fps: float) -> dict[str, Array]:
    rows = slice(begin, end)
    wide = {_STATE: dataset["observation"][rows], "action": dataset["action"][rows]}
    rewards = {"next.reward": dataset["reward"][rows]} if "reward" in dataset.columns else {}
    step, index = dataset["step"][rows].astype(np.int64), np.arange(begin, end)
    return {
        **wide,
        **rewards,
        "timestamp": (step / fps).astype(np.float32),
        "frame_index": step,
        "episode_index": dataset["episode"][rows].astype(np.int64),
        "index": index,
        "task_index": 0 * index,
    }


def _write_steps(dataset: Dataset, path: Path, fps: float) -> None:
    def table(begin: int, end: int) -> pa.Table:
        columns = _columns(dataset, begin, end, fps)
        return pa.table({name: column_of(values) for name, values in columns.items()})

    ends = accumulate((shard.rows for shard in dataset.manifest.shards), initial=0)
    with pq.ParquetWriter(path, table(0, 0).schema) as writer:
        for begin, end in Progress([*pairwise(ends)], unit="shard", desc=path.name):
            writer.write_table(table(begin, end))


def _write_meta(dataset: Dataset, folder: Path, fps: float) -> None:
    lengths, task = dataset.episodes["length"].astype(np.int64), dataset.task
    ends, count = np.cumsum(lengths), len(lengths)
    places = [
        f"{part}/{what}_index" for part in ("data", "meta/episodes") for what in ("chunk", "file")
    ]
    episodes = {
        "episode_index": np.arange(count),
        "tasks": [[task.name]] * count,
        "length": lengths,
    }
    episodes |= {"dataset_from_index": ends - lengths, "dataset_to_index": ends}
    episodes |= dict.fromkeys(places, np.zeros(count, np.int64))
    pq.write_table(pa.table(episodes), folder / _EPISODES.format(chunk_index=0, file_index=0))
    tasks = pa.table({"task_index": [0], _INDEX: [task.name]})
    tasks = tasks.replace_schema_metadata({"pandas": json.dumps(_OF_PANDAS)})
    pq.write_table(tasks, folder / "meta/tasks.parquet")
    names = {_STATE: list(task.feature_names), "action": list(task.named_actions)}
    features, stats = dict[str, Any](), dict[str, Any]()
    for name, values in _columns(dataset, 0, 0, fps).items():
        shape = list(values.shape[1:]) or [1]
        features[name] = {"dtype": str(values.dtype), "shape": shape, "names": names.get(name)}
    for name, of in ((_STATE, "observation"), ("action", "action")):
        (low, high), (mean, std) = extrema(dataset[of].chunks()), mean_and_std(dataset[of].chunks())
        statistics = {"min": low, "max": high, "mean": mean, "std": std, "count": [len(dataset)]}
        stats[name] = {what: np.asarray(each).tolist() for what, each in statistics.items()}
    info = {"codebase_version": "v3.0", "robot_type": None, "fps": fps, "features": features}
    info |= {"total_episodes": count, "total_frames": len(dataset), "total_tasks": 1}
    info |= {"splits": {"train": f"0:{count}"}, "data_path": _DATA, "video_path": None}
    info |= {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
    info[_OFFSETS] = task.offset.tolist()
    for path, content in {"meta/stats.json": stats, INFO: info}.items():
        (folder / path).write_text(json.dumps(content, indent=4))
