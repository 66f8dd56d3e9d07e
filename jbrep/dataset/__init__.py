"""Data sets: folders of HDF5 shards of flat columns, named by a manifest."""

from jbrep.dataset.columns import Batches, Column, Scaler
from jbrep.dataset.manifest import Settings
from jbrep.dataset.reader import Dataset, Split
from jbrep.dataset.scaled import ScaledDataset
from jbrep.errors import DamageError

__all__ = [
    "Batches",
    "Column",
    "DamageError",
    "Dataset",
    "ScaledDataset",
    "Scaler",
    "Settings",
    "Split",
]
