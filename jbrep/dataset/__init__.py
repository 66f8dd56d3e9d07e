"""Data sets: folders of HDF5 shards of flat columns, named by a manifest."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.dataset.columns import Column as Column
    from jbrep.dataset.formats.writer import from_arrays as from_arrays
    from jbrep.dataset.formats.writer import from_file as from_file
    from jbrep.dataset.formats.writer import from_table as from_table
    from jbrep.dataset.layout import Layout as Layout
    from jbrep.dataset.reader import Dataset as Dataset
    from jbrep.dataset.reader import Episode as Episode
    from jbrep.dataset.reader import Split as Split
    from jbrep.dataset.scaled import ScaledDataset as ScaledDataset
    from jbrep.dataset.scaling import Scaler as Scaler
    from jbrep.dataset.schema import DataSettings as DataSettings
    from jbrep.errors import DamageError as DamageError

__getattr__, __dir__, __all__ = exports(__name__)
