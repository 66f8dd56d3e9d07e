"""Data sets: folders of HDF5 shards of flat columns, named by a manifest."""

from typing import TYPE_CHECKING

from jbrep.errors import DamageError
from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.dataset.columns import Batches, Column
    from jbrep.dataset.layout import Layout
    from jbrep.dataset.reader import Dataset, Episode, Split
    from jbrep.dataset.scaled import ScaledDataset
    from jbrep.dataset.scaling import Scaler
    from jbrep.dataset.schema import DataSettings

__all__ = [
    "Batches",
    "Column",
    "DamageError",
    "DataSettings",
    "Dataset",
    "Episode",
    "Layout",
    "ScaledDataset",
    "Scaler",
    "Split",
]

__getattr__, __dir__ = exports(
    __name__,
    {
        **{"Batches": "columns", "Column": "columns", "DataSettings": "schema"},
        **{"Layout": "layout", "Dataset": "reader", "Episode": "reader", "Split": "reader"},
        **{"ScaledDataset": "scaled", "Scaler": "scaling"},
    },
)
