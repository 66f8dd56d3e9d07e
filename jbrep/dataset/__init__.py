"""Data sets: folders of HDF5 shards of flat columns, named by a manifest."""

from jbrep.dataset.columns import Batches, Column
from jbrep.dataset.reader import Dataset, Episode, Split
from jbrep.dataset.scaled import ScaledDataset
from jbrep.dataset.scaling import Scaler
from jbrep.dataset.settings import Settings
from jbrep.errors import DamageError

__all__ = [
    "Batches",
    "Column",
    "DamageError",
    "Dataset",
    "Episode",
    "ScaledDataset",
    "Scaler",
    "Settings",
    "Split",
]
