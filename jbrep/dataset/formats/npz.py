"""One npz file: arrays as Gymnasium's users name them, or all columns as jbrep writes them."""

from pathlib import Path
from typing import Any

import numpy as np

from jbrep.dataset.formats.arrays import frame_of_steps
from jbrep.dataset.formats.frame import About, Frame, label_of
from jbrep.dataset.reader import Dataset
from jbrep.errors import first_line, refusing
from jbrep.records.storage import publish, unfinished

_EPISODES = "episodes/"  # of columns with a row for each episode, as jbrep writes them
_ONCE = {  # what is known once for each episode, by the names of arrays
    f"{_EPISODES}final_observation": "final_observation",
    "final_observations": "final_observation",
    f"{_EPISODES}terminated": "terminated",
    f"{_EPISODES}truncated": "truncated",
    f"{_EPISODES}seed": "seed",
    "seeds": "seed",
}
_ABOUT = {"feature_names": str, "feature_units": str, "feature_offsets": float}


def read(given: str) -> Frame:
    """Read all arrays; objects, which would have to be unpickled, are refused."""
    path = Path(given)
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict[str, Any]()
        for name in archive.files:
            with refusing(f"{given}: {name!r} can't be read", describe=first_line):
                arrays[name] = np.asarray(archive[name])
        names, units, offsets = (
            tuple(kind(each) for each in arrays.pop(name, np.array(())).ravel())
            for name, kind in _ABOUT.items()
        )
    once = {what: arrays.pop(name) for name, what in _ONCE.items() if name in arrays}
    columns = {name: each for name, each in arrays.items() if not name.startswith(_EPISODES)}
    about = About(names, units, offsets)
    return frame_of_steps(given, columns, once, about, label=label_of(path.stem))


def write(dataset: Dataset, out: Path) -> str:
    """Write all columns, uncompressed; returns how to open them."""
    task = dataset.task
    arrays: dict[str, Any] = {
        f"{_EPISODES}{name}": values for name, values in dataset.episodes.items()
    }
    arrays["feature_names"] = np.array(task.feature_names)
    arrays["feature_units"] = np.array([feature.unit for feature in task.features])
    arrays["feature_offsets"] = task.offset
    columns: dict[str, Any] = {name: dataset[name] for name in dataset.columns}
    with unfinished(out) as partial:
        with partial.open("xb") as file:
            np.savez(file, **arrays, **columns)  # each is read when it is written
        publish(partial, out)
    return f"numpy.load({str(out)!r})"
