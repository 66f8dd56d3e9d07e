"""Reading a data set."""

import hashlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.dataset.columns import Column
from jbrep.dataset.manifest import check_sizes, open_shard, read_manifest
from jbrep.dataset.scaling import EXTREMA, Scaler, extrema, fit_scaler, mean_and_std
from jbrep.dataset.schema import Columns, episode_bounds, episode_columns
from jbrep.dataset.settings import policy_text
from jbrep.envs.card import range_text
from jbrep.errors import DamageError, InputError
from jbrep.text import Table, counted, facts, number, percentiles

_OPEN_SHARDS = 100  # memory-mapped at a time, at most: each takes a file descriptor
_AHEAD = 8  # shards that are checked at a time, at most
_RETURNS = (
    "median {median:z,.1f} [10 % {p10:z,.1f}, 90 % {p90:z,.1f}], mean {mean:z,.1f}, "
    "from {min:z,.1f} to {max:z,.1f}"
)
_RANGES = ("feature", "unit", "min", "mean", "max", "std", "usual range")


class Split(NamedTuple):
    """Sorted row numbers; no episode is on both sides."""

    train: NDArray[np.int64]
    test: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of a data set."""

    dataset: "Dataset"
    number: int  # from 0
    rows: slice  # in the columns of the data set

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
    """A data set: the shards that were there when it was opened.

    `dataset["observation"]` is a `Column`: one array over all shards that copies only what is
    asked for. So are the other columns, the groups of features (`dataset["velocity"]`) and the
    single features (`dataset["velocity_x"]`). Each shard is checked against its hash once, before
    its first row is read.

    Args:
        folder: that `jbrep collect` or `jbrep data import` wrote.

    Attributes:
        manifest: settings, versions and hashes.
        task: the task whose features the observations hold.

    A DamageError says that a file is damaged or missing, also later, when its rows are read.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.manifest = read_manifest(self.folder)
        check_sizes(self.folder, self.manifest)
        self.task = self.manifest.task
        self._known: set[int] = set()  # shards whose hashes have been checked
        self._shard = lru_cache(_OPEN_SHARDS)(self._open)
        self._ends = list(accumulate(entry.rows for entry in self.manifest.shards))
        self._specs = self.manifest.settings.step_specs()

    def _open(self, shard: int) -> Columns:
        """A shard, once its hash has been checked: with those of the next ones, on all cores."""

        def check(other: int) -> None:
            with suppress(InputError):  # which is raised when that one is opened
                open_shard(self.folder, self.manifest, other)
                self._known.add(other)

        if shard not in self._known:
            unknown = [k for k in range(shard, len(self._ends)) if k not in self._known]
            with ThreadPoolExecutor() as pool:
                list(pool.map(check, unknown[:_AHEAD]))
        try:
            return open_shard(self.folder, self.manifest, shard, known=shard in self._known)
        except DamageError:
            if read_manifest(self.folder) == self.manifest:
                raise
            raise InputError(f"{self.folder} was extended meanwhile: open it again") from None

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __iter__(self) -> Iterator[Episode]:
        """All episodes, one after the other."""
        return map(self.episode, range(len(self.episodes["length"])))

    def __reduce__(self) -> tuple[Any, ...]:
        return Dataset, (self.folder,)  # another process opens it anew

    def __repr__(self) -> str:
        return f"Dataset({str(self.folder)!r}: {self.task.name}, {len(self):,} rows)"

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
        return self.task.groups | {name: i for i, name in enumerate(self.task.feature_names)}

    @cached_property
    def episodes(self) -> dict[str, NDArray[Any]]:
        """Columns with a row for each episode: seed, length, return, terminated and more."""
        specs = episode_columns(self.manifest.settings.specs())
        parts = {name: [np.empty((0, *spec.row), spec.dtype)] for name, spec in specs.items()}
        for shard in range(len(self._ends)):
            for name, each in episode_columns(self._shard(shard)).items():
                parts[name].append(each.copy())  # a view would keep the file open
        return {name: np.concatenate(each) for name, each in parts.items()}

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 over the hashes of all columns, shard by shard: it identifies the data."""
        whole = hashlib.sha256()
        for shard in range(len(self._ends)):
            for name, values in self._shard(shard).items():
                whole.update(f"{name} {hashlib.sha256(values.data).hexdigest()}\n".encode())
        return whole.hexdigest()

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
        if not 0 < test < 1:
            raise InputError(f"the share to hold out is {test}: it must be between 0 and 1")
        lengths = self.episodes["length"]
        number = len(lengths)
        if number < 2:
            raise InputError(
                f"a split needs at least 2 episodes: {self.folder} has {number}; "
                "collect more, or cut what is imported into several"
            )
        count = min(max(1, round(test * number)), number - 1)
        held_out = np.isin(range(number), np.random.default_rng(seed).permutation(number)[:count])
        is_test = np.repeat(held_out, lengths)
        return Split(np.flatnonzero(~is_test), np.flatnonzero(is_test))

    def fit_scaler(self, rows: NDArray[np.int64]) -> Scaler:
        """The scaling of observations to [-1, 1] over some rows, such as the training part."""
        return fit_scaler(EXTREMA, self.task, self["observation"], rows)

    def describe(self) -> dict[str, Any]:
        """What it holds, how it was made, its returns and the ranges of its features, as JSON."""
        manifest, settings, episodes = self.manifest, self.manifest.settings, self.episodes
        note = ""
        if settings.is_imported:
            note = "the data were imported: no episode can be simulated again"
        elif not self.task.reproducible:
            note = "the environment is not reproducible: no episode can be simulated again"
        return {
            "folder": str(self.folder),
            **settings.as_json(),
            "rows": len(self),
            "complete": manifest.complete,
            "episodes": len(episodes["length"]),
            "terminated": int(episodes["terminated"].sum()),
            "length": _spread(episodes["length"]),
            "return": _spread(episodes.get("return", ())),
            "columns": list(self.columns),
            "shards": len(manifest.shards),
            "bytes": manifest.bytes,
            "versions": dict(manifest.versions),
            "fingerprint": self.fingerprint,
            **({"note": note} if note else {}),
            "features": self._ranges() if len(self) else [],
        }

    def _ranges(self) -> list[dict[str, Any]]:
        column = self["observation"]
        (low, high), (mean, std) = extrema(column.chunks()), mean_and_std(column.chunks())
        found = zip(self.task.features, low, mean, high, std, strict=True)
        return [
            {"feature": feature.name, "unit": feature.unit}
            | dict(zip(_RANGES[2:6], map(float, values), strict=True))
            | {"nominal": [feature.low, feature.high]}
            for feature, *values in found
        ]

    def card(self, width: int = 80) -> str:
        """`describe` as text of at most `width` columns."""
        about, rows = self.describe(), []
        for each in about.pop("features"):
            low, high = each["nominal"]
            usual = "-" if low is high is None else range_text(low, high)
            values = [number(each[name], ".4g") for name in _RANGES[2:6]]
            rows.append((each["feature"], each["unit"], *values, usual))
        sizes = counted(self.task.size, "feature"), counted(self.task.action_size, "action")
        episodes, length, returns = f"{about['episodes']:,}", about["length"], about["return"]
        if length:
            low, high = (f"{length[end]:,.0f}" for end in ("min", "max"))
            episodes += f" of {low} steps" if low == high else f" of {low} to {high} steps"
        if ended := about["terminated"]:
            episodes += f", {ended:,} terminated by a state"
        unfinished = "" if about["complete"] else f" of {about['steps']:,} that were asked for"
        named = {
            "task": ", ".join([self.task.name, *sizes, *self.task.given_arguments]),
            "policy": policy_text(about["policy"]),
            "seed": "-" if self.manifest.settings.is_imported else str(about["seed"]),
            "rows": f"{about['rows']:,}{unfinished}",
            "episodes": episodes,
            "return": _RETURNS.format(**returns) if returns else "not known",
            "columns": ", ".join(about["columns"]),
            "files": f"{counted(about['shards'], 'shard')}, {about['bytes'] / 1e6:,.1f} MB",
            "made with": ", ".join(f"{name} {what}" for name, what in about["versions"].items()),
            "fingerprint": about["fingerprint"],
        }
        if self.task.timestep is not None:
            named["time step"] = f"{self.task.timestep:.4g} s"
        if names := self.task.action_names:
            named["actions"] = ", ".join(names)
        if code := self.manifest.settings.reward:
            named["reward"] = f"by {code}"
        if note := about.get("note"):
            named["note"] = note
        text = f"{self.folder}\n{facts(named, width)}"
        return f"{text}\n\n{Table('', _RANGES, rows).text(width)}" if rows else text


def _spread(values: Any) -> dict[str, float]:
    if not len(values):
        return {}
    others = {"mean": values.mean(), "min": values.min(), "max": values.max()}
    return percentiles(values) | {name: float(value) for name, value in others.items()}
