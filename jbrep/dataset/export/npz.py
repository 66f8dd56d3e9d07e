"""Exporting to one npz file: all columns as arrays."""

import zipfile
from pathlib import Path

import numpy as np

from jbrep.dataset import Dataset
from jbrep.progress import Progress
from jbrep.records.publish import publish_file, unfinished


def write(dataset: Dataset, out: Path) -> str:
    """Stream the columns to an uncompressed zip; returns how to open it."""
    with unfinished(out) as partial:
        _write_zip(dataset, partial, out.name)
        publish_file(partial, out)
    return f"numpy.load({str(out)!r})"


def _write_zip(dataset: Dataset, path: Path, name: str) -> None:
    arrays = {f"episodes/{name}": values for name, values in dataset.episodes.items()}
    arrays["feature_names"] = np.array(dataset.task.feature_names)
    arrays["feature_units"] = np.array([feature.unit for feature in dataset.task.features])
    with zipfile.ZipFile(path, "w", allowZip64=True) as archive:
        for column_name in Progress(dataset.columns, unit="column", desc=name):
            column = dataset[column_name]
            with archive.open(f"{column_name}.npy", "w", force_zip64=True) as file:
                header = {"descr": column.dtype.str, "fortran_order": False, "shape": column.shape}
                np.lib.format.write_array_header_1_0(file, header)
                for chunk in column.chunks():
                    file.write(np.ascontiguousarray(chunk).data)
        for array_name, values in arrays.items():
            with archive.open(f"{array_name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
