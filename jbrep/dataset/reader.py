"""A data set as a reader sees it."""

from collections.abc import Sequence
from functools import cached_property, lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Batches, Column, Scaler
from jbrep.dataset.manifest import check_files, hdf5_files, open_shard, read_manifest
from jbrep.dataset.schema import EPISODES, step_specs
from jbrep.dataset.shard import Shard
from jbrep.errors import InputError

_OPEN_SHARDS = 256  # memory-mapped at a time: each takes a file descriptor
_MEMORY = 4 << 30  # [bytes]


class Split(NamedTuple):
    """Sorted row numbers; no episode is on both sides."""

    train: NDArray[np.int64]
    test: NDArray[np.int64]


class Dataset:
    """A collected data set; a shard is checked against the manifest before a row of it is seen.

    `dataset["observation"]` is a `Column`: one array over all shards that copies only what is
    asked for. So are the other columns, the observables (`dataset["velocity"]`) and the single
    features (`dataset["velocity_x"]`). While a collector writes, it is the part committed when
    the data set was opened.

    Args:
        folder: where `jbrep collect` wrote it.

    Attributes:
        manifest: settings, versions and hashes.
        task: the task whose features the observations hold.

    Raises:
        InputError: no data set there.
        DamageError: a file is damaged, missing or not one of the data set; also later, when
            rows of a damaged shard are asked for.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        files = hdf5_files(self.folder)
        self.manifest = read_manifest(self.folder)
        check_files(self.folder, self.manifest, files)
        self.task = self.manifest.task
        self._known: set[tuple[int, ...]] = set()
        self._shard = lru_cache(_OPEN_SHARDS)(self._open)
        self._ends = list(accumulate(entry.rows for entry in self.manifest.shards))
        self._specs = step_specs(self.task, self.manifest.settings.store_state)

    def _open(self, shard: int) -> Shard:
        return open_shard(self.folder, self.manifest, shard, self._known)

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.folder,)  # another process opens it anew

    def __repr__(self) -> str:
        return f"Dataset({str(self.folder)!r}: {self.task.name}, {len(self):,} rows)"

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns with a row for each control step."""
        return tuple(self._specs)

    def __getitem__(self, name: str) -> Column:
        if name in self._specs:
            spec = self._specs[name]
            return Column(lambda k: self._shard(k)[name], self._ends, spec.dtype, spec.row)
        places = self._places
        if name not in places:
            raise InputError(
                f"no column, observable or feature {name!r}: choose one of "
                f"{', '.join(dict.fromkeys((*self._specs, *places)))}"
            )
        place, row = places[name]
        dtype = self._specs["observation"].dtype
        return Column(lambda k: self._shard(k)["observation"][:, place], self._ends, dtype, row)

    @cached_property
    def _places(self) -> dict[str, tuple[int | slice, tuple[int, ...]]]:
        """Where observables and features stand in an observation, and the shape of their rows."""
        places: dict[str, tuple[int | slice, tuple[int, ...]]] = {}
        start = 0
        for observable in self.task.observables:
            size = len(observable.features)
            places[observable.name] = slice(start, start + size), (size,)
            for i, feature in enumerate(observable.features):
                places[feature.name] = start + i, ()
            start += size
        return places

    @cached_property
    def episodes(self) -> dict[str, NDArray[Any]]:
        """Columns with a row for each episode: seed, length, return, initial_qpos and more."""
        shards = [self._shard(k) for k in range(len(self.manifest.shards))]
        specs = self.manifest.settings.specs()
        return {
            name.removeprefix(EPISODES): np.concatenate(
                [np.empty(spec.shape(0), spec.dtype), *(shard[name] for shard in shards)]
            )
            for name, spec in specs.items()
            if name.startswith(EPISODES)
        }

    def split(self, test: float = 0.2, seed: int = 0) -> Split:
        """Rows to train on and rows held out; no episode is in both.

        Args:
            test: share of the episodes to hold out, in (0, 1); at least one episode.
            seed: of the draw.

        Raises:
            InputError: fewer than two episodes with rows, or a share out of range.
        """
        if not 0 < test < 1:
            raise InputError(f"the share to hold out is {test}: it must be between 0 and 1")
        lengths = self.episodes["length"]
        filled = np.flatnonzero(lengths)
        if len(filled) < 2:
            raise InputError(f"{len(filled)} episode can't be split: collect at least 2")
        count = min(max(1, round(test * len(filled))), len(filled) - 1)
        held_out = np.zeros(len(lengths), dtype=bool)
        held_out[np.random.default_rng(seed).permutation(filled)[:count]] = True
        is_test = np.repeat(held_out, lengths)
        return Split(np.flatnonzero(~is_test), np.flatnonzero(is_test))

    def fit_scaler(self, rows: NDArray[np.int64]) -> Scaler:
        """The scaling of observations to [-1, 1] over those rows: the training part's, say."""
        return Scaler.fit(self["observation"], rows)

    def batches(
        self,
        rows: NDArray[np.int64] | None = None,
        columns: Sequence[str] = ("observation",),
        size: int = 8192,
        seed: int = 0,
        memory: int = _MEMORY,
    ) -> Batches:
        """Shuffled passes over rows, from memory or, where they don't fit, from the disk.

        Args:
            rows: sorted row numbers; all if not given.
            columns: names of columns, observables or features.
            size: rows in a batch.
            seed: of the order.
            memory: bytes that may be held.
        """
        rows = np.arange(len(self)) if rows is None else rows
        return Batches({name: self[name] for name in columns}, rows, size, seed, memory)
