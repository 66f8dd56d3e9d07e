"""Reading a data set."""

import resource
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Batches, Column
from jbrep.dataset.layout import Layout
from jbrep.dataset.manifest import (
    check_files,
    current_manifest,
    hdf5_files,
    open_shard,
    shard_name,
)
from jbrep.dataset.scaling import EXTREMA, Scaler, fit_scaler
from jbrep.dataset.schema import EPISODES, Columns, episode_bounds, episode_columns
from jbrep.dataset.shard import Checked, FileState, file_state
from jbrep.envs.task import Task
from jbrep.errors import DamageError, InputError

if TYPE_CHECKING:
    from jbrep.dataset.formats.source import Source

_OPEN_SHARDS = 256  # memory-mapped at a time, at most: each takes a file descriptor
_MEMORY = 4 << 30  # [bytes]


class Split(NamedTuple):
    """Sorted row numbers; no episode is on both sides."""

    train: NDArray[np.int64]
    test: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of a data set.

    Attributes:
        dataset: the data set.
        number: of the episode, from 0.
        rows: its rows in the columns of the data set.
    """

    dataset: "Dataset"
    number: int
    rows: slice

    def __len__(self) -> int:
        return int(self.rows.stop - self.rows.start)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Its rows of a column, a group of features or a feature, (len(self), ...)."""
        return self.dataset[name][self.rows]

    @property
    def record(self) -> dict[str, Any]:
        """What is stored once per episode: seed, length, return, terminated and more."""
        return {name: column[self.number] for name, column in self.dataset.episodes.items()}

    def __repr__(self) -> str:
        return f"Episode({self.number} of {str(self.dataset.folder)!r}, {len(self):,} rows)"


class Dataset:
    """A collected data set; every shard is checked against the manifest before it is read.

    `dataset["observation"]` is a `Column`: one array over all shards that copies only what is
    asked for. So are the other columns, the groups of features (`dataset["velocity"]`) and the
    single features (`dataset["velocity_x"]`). While a collector writes, it is the part committed
    when the data set was opened. A shard that changes on disk is checked again when it is next
    used; arrays taken from it before are views of the file, and may change with it.

    Args:
        folder: that `jbrep collect`, `jbrep data import` or `Dataset.write` wrote.

    Attributes:
        manifest: settings, versions and hashes.
        task: the task whose features the observations hold.

    Raises:
        DamageError: a file is damaged, missing or not part of the data set; also later, when
            rows of a damaged shard are read.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        files = hdf5_files(self.folder)
        self.manifest = current_manifest(self.folder)
        check_files(self.folder, self.manifest, files)
        self.task = self.manifest.task
        self._checked: set[Checked] = set()
        self._opened = lru_cache(_open_at_once())(self._open)
        shards = range(len(self.manifest.shards))
        self._paths = [self.folder / shard_name(k) for k in shards]  # looked at for every chunk
        self._ends = list(accumulate(entry.rows for entry in self.manifest.shards))
        self._specs = self.manifest.settings.step_specs()

    @staticmethod
    def write(
        folder: str | Path,
        observations: Any,
        actions: Any,
        rewards: Any,
        terminations: Any,
        truncations: Any = None,
        *,
        final_observations: Any = None,
        seeds: Any = None,
        task: Task | str | None = None,
        source: str = "arrays",
    ) -> "Dataset":
        """Write a data set of arrays, whole or not at all.

        The first five are of all episodes, one after the other: N steps of d features and actions
        of k numbers. Or each is a list of such arrays, one for each of the n episodes.

        Args:
            folder: new.
            observations: before each action, (N, d). In a list, the observations of an episode may
                have one row more than the rest: the final one.
            actions: (N, k).
            rewards: (N,); None where none are known.
            terminations: whether a state ended the episode at that step, (N,).
            truncations: whether anything else did, such as a time limit, (N,).
            final_observations: after the last action of each episode, (n, d). Where they aren't
                known, the last step of each episode is left out, so that its observation is the
                final one, and the episode counts as truncated.
            seeds: that the episodes were started with, (n,); -1 where one isn't known.
            task: that they are of, or its name; made from the data alone if not given.
            source: where they come from, a few words; also the id of a task made from the data.

        Returns:
            The data set.
        """
        from jbrep.dataset.formats.arrays import frame_in_python  # imports Arrow
        from jbrep.dataset.formats.source import Source

        columns = {"observation": observations, "action": actions, "reward": rewards}
        columns |= {"terminated": terminations, "truncated": truncations}
        once = {"final_observation": final_observations, "seed": seeds}
        opened = Source(frame_in_python(columns, once, source))
        return _written(folder, opened, None, "", task)

    @staticmethod
    def from_table(
        folder: str | Path,
        table: Any,
        layout: Layout | None = None,
        *,
        missing: str = "",
        task: Task | str | None = None,
        source: str = "table",
    ) -> "Dataset":
        """Write a data set of a table's rows, such as a robot's log, whole or not at all.

        Args:
            folder: new.
            table: a frame of pandas or polars, a table of pyarrow's, or a dict of columns.
            layout: what its columns are, and what becomes of its rows.
            missing: what becomes of numbers that are missing: skip, or hold:3 and the like.
            task: that the rows are of, or its name; made from the data alone if not given.
            source: where they come from, a few words; also the id of a task made from the data.

        Returns:
            The data set.
        """
        from jbrep.dataset.formats.frame import frame_of_table
        from jbrep.dataset.formats.source import Source

        opened = Source(frame_of_table(table, source), layout, missing)
        return _written(folder, opened, layout, missing, task)

    @staticmethod
    def from_file(
        folder: str | Path,
        file: str | Path,
        *more: str | Path,
        layout: Layout | None = None,
        missing: str = "",
        task: Task | str | None = None,
    ) -> "Dataset":
        """Write a data set of others' files, whole or not at all, as `jbrep data import` does.

        Args:
            folder: new.
            file: a log, or a data set of another tool, see docs/logs.md.
            more: such files; an episode ends with each.
            layout: as `from_table` takes it, like missing and task.
            missing: likewise.
            task: likewise; by default the one that the files name, if they do.

        Returns:
            The data set.

        Raises:
            ModuleNotFoundError: their format needs a package that isn't installed.
        """
        from jbrep.dataset.formats import open_sources

        opened = open_sources([*map(str, (file, *more))], layout, missing)
        return _written(folder, opened, layout, missing, task)

    def _shard(self, shard: int) -> Columns:
        """A shard as it is on disk now: another state of its file is another entry of the cache."""
        return self._opened(shard, file_state(self._paths[shard]))

    def _open(self, shard: int, state: FileState) -> Columns:
        try:
            return open_shard(self.folder, self.manifest, shard, self._checked)
        except DamageError:
            if (grown := self._grown(shard)) is None:
                raise
            return grown

    def _grown(self, shard: int) -> Columns | None:
        """What there was of a shard to which a collector has added episodes since; None if none."""
        with suppress(InputError):
            settings, now = self.manifest.settings, current_manifest(self.folder)
            before, entry = self.manifest.shards[shard], now.shards[shard : shard + 1]
            is_ours = now.settings.replace(steps=settings.steps) == settings
            if is_ours and entry and entry[0].episodes > before.episodes:
                whole = open_shard(self.folder, now, shard)
                return whole.first(before.rows, before.episodes)
        return None

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.folder,)  # another process opens it anew

    def __repr__(self) -> str:
        return f"Dataset({str(self.folder)!r}: {self.task.name}, {len(self):,} rows)"

    def _repr_html_(self) -> str:
        from jbrep.dataset.card import card_html

        return card_html(self)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns with a row for each step."""
        return tuple(self._specs)

    def __getitem__(self, name: str) -> Column:
        if name in self._specs:
            spec = self._specs[name]
            return Column(lambda k: self._shard(k)[name], self._ends, spec.dtype, spec.row)
        places = self._places
        if name == "reward" and name not in places:
            raise InputError(f"{self.folder} has no rewards: jbrep data derive --reward gives some")
        if name not in places:
            raise InputError(
                f"no column, group or feature {name!r}: choose one of "
                f"{', '.join(dict.fromkeys((*self._specs, *places)))}"
            )
        place, spec = places[name], self._specs["observation"]
        row = np.empty(spec.row)[place].shape
        return Column(
            lambda k: self._shard(k)["observation"][:, place], self._ends, spec.dtype, row
        )

    @cached_property
    def _places(self) -> dict[str, int | slice]:
        """Index in an observation of each group and feature."""
        return self.task.groups | {name: i for i, name in enumerate(self.task.feature_names)}

    @cached_property
    def episodes(self) -> dict[str, NDArray[Any]]:
        """Columns with a row for each episode: seed, length, return, terminated and more."""
        specs = episode_columns(self.manifest.settings.specs())
        parts = {name: [np.empty((0, *spec.row), spec.dtype)] for name, spec in specs.items()}
        for number in range(len(self.manifest.shards)):
            shard = self._shard(number)
            for name, each in parts.items():
                each.append(shard[EPISODES + name].copy())  # a view would keep the file open
        return {name: np.concatenate(each) for name, each in parts.items()}

    @cached_property
    def _bounds(self) -> NDArray[np.int64]:
        return episode_bounds(self.episodes["length"])

    def episode(self, number: int) -> Episode:
        """One episode: its rows, its part of each column, and what is stored once for it."""
        count = len(self.episodes["length"])
        if not 0 <= number < count:
            raise InputError(
                f"{self.folder} has no episode {number}: it has {count:,}, numbered from 0"
            )
        start, stop = self._bounds[number : number + 2].tolist()
        return Episode(self, number, slice(start, stop))

    def split(self, test: float = 0.2, seed: int = 0) -> Split:
        """Rows to train on and rows held out; no episode is in both.

        Args:
            test: share of the episodes to hold out, in (0, 1); at least one is held out.
            seed: of the draw.
        """
        lengths = self.episodes["length"]
        held_out = np.zeros(len(lengths), dtype=bool)
        held_out[self.split_episodes(test, seed).test] = True
        is_test = np.repeat(held_out, lengths)
        return Split(np.flatnonzero(~is_test), np.flatnonzero(is_test))

    def split_episodes(self, test: float = 0.2, seed: int = 0) -> Split:
        """The same split as `split`, by the numbers of the episodes, sorted."""
        if not 0 < test < 1:
            raise InputError(f"the share to hold out is {test}: it must be between 0 and 1")
        number = len(self.episodes["length"])
        if number < 2:
            raise InputError(
                f"a split needs at least 2 episodes: {self.folder} has {number}; "
                "collect more, or cut what is imported into several"
            )
        count = min(max(1, round(test * number)), number - 1)
        order = np.random.default_rng(seed).permutation(number)
        return Split(np.sort(order[count:]), np.sort(order[:count]))

    def fit_scaler(self, rows: NDArray[np.int64]) -> Scaler:
        """The scaling of observations to [-1, 1] over some rows, such as the training part."""
        return fit_scaler(EXTREMA, self.task, self["observation"], rows)

    def batches(
        self,
        rows: NDArray[np.int64] | None = None,
        columns: Sequence[str] = ("observation",),
        size: int = 8192,
        seed: int = 0,
        memory: int = _MEMORY,
    ) -> Batches:
        """Shuffled passes over rows, from memory or, if they don't fit, from disk.

        Args:
            rows: sorted row numbers; None takes all.
            columns: names of columns, groups or features.
            size: rows per batch.
            seed: of the order.
            memory: limit of the rows held in memory [bytes].
        """
        rows = np.arange(len(self)) if rows is None else rows
        return Batches({name: self[name] for name in columns}, rows, size, seed, memory)


def _open_at_once() -> int:
    """How many shards to have open: they take half of the files that the process may, at most."""
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return _OPEN_SHARDS if most == resource.RLIM_INFINITY else min(_OPEN_SHARDS, most // 2)


def _written(
    folder: str | Path,
    source: "Source",
    layout: Layout | None,
    missing: str,
    task: Task | str | None,
) -> Dataset:
    """A data set of what was opened."""
    from jbrep.dataset.formats.writer import write
    from jbrep.envs.description import as_task
    from jbrep.envs.names import is_code

    reward = layout.reward if layout and is_code(layout.reward) else ""
    known = None if task is None else as_task(task)
    write(source, Path(folder), known, missing=missing, reward=reward)
    return Dataset(folder)
