"""HDF5 files of D4RL's layout, and of robomimic's, which Isaac Lab writes, too.

D4RL's have a row for each step of all episodes: `observations`, `actions`, `rewards`, `terminals`
and `timeouts`. Robomimic's have a group for each episode, `data/demo_0` and so on, with `actions`,
`rewards`, `dones`, and in `obs` and `next_obs` an array for each thing that is observed.
"""

import json
import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jbrep.dataset.columns import Array
from jbrep.dataset.formats.arrays import frame_of_arrays, is_image, joined
from jbrep.dataset.formats.frame import About, Frame, label_of, own_names
from jbrep.dataset.layout import Layout
from jbrep.errors import InputError, refusing
from jbrep.text import counted

_NOW, _NEXT = "obs/", "next_obs/"


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file, all of whose contents are in itself."""
    with refusing(f"{path} can't be read as an HDF5 file"), h5py.File(path) as file:

        def problem(name: str, link: Any) -> str | None:
            if not isinstance(link, h5py.HardLink):
                return f"{name} is a link, which isn't followed"
            found = file[name]
            is_outside = isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)
            return f"{name} is in another file, which isn't opened" if is_outside else None

        if found := file.visititems_links(problem):
            raise InputError(f"{path}: {found}")
        yield file


def read(given: str) -> Frame:
    """Read all numbers of a file of either layout."""
    with opened(Path(given)) as file:
        data = file.get("data")
        groups = data.items() if isinstance(data, h5py.Group) else ()
        demos = [n for n, each in groups if isinstance(each, h5py.Group) and "actions" in each]
        demos.sort(key=lambda name: (len(name), name))  # demo_10 comes after demo_9
        if demos:
            parts = {f"data/{name}": _arrays(data[name]) for name in demos}
            return _frame_of_demos(given, parts, data.attrs.get("env_args", "{}"))
        arrays = _arrays(file)
    own = own_names(given, arrays).keys()
    if not {"observation", "action"} <= own:
        raise InputError(
            f"{given} has neither observations and actions, as D4RL's files do, nor data/demo_0 "
            "and so on with actions, as robomimic's"
        )
    ends = "no timeouts or next observations: only terminations end episodes; --length cuts more"
    notes = () if own & {"truncated", "next_observation", "episode", "step"} else (ends,)
    label = label_of(Path(given).stem)
    return frame_of_arrays(given, arrays, label=label, about=_about(arrays), notes=notes)


def _arrays(group: h5py.Group) -> dict[str, Array]:
    """The arrays of numbers with rows, by their paths in a group; images are not read."""
    found = dict[str, Array]()

    def visit(name: str, each: Any) -> None:
        if isinstance(each, h5py.Dataset) and each.shape and each.dtype.kind in "fiub":
            found[name] = np.broadcast_to(each[:1], each.shape) if is_image(each) else each[:]

    group.visititems(visit)
    return found


def _frame_of_demos(name: str, demos: dict[str, dict[str, Array]], env_args: Any) -> Frame:
    early, episodes, after = 0, dict[str, dict[str, Array]](), dict[str, str]()
    for where, arrays in demos.items():
        steps = len(arrays["actions"])
        dones = np.ravel(arrays.pop("dones", np.zeros(steps)))
        if len(dones) != steps or np.isnan(dones).any():
            raise InputError(
                f"{name}, {where} has {len(dones)} dones for {steps} actions: give one for each, "
                "none NaN"
            )
        ends = dones > 0
        early += int(ends[:-1].sum())
        after = after or {
            _column(each, arrays): _NEXT + each.removeprefix(_NOW)
            for each, values in arrays.items()
            if each.startswith(_NOW) and not is_image(values)
        }
        columns = {_column(each, arrays): values for each, values in arrays.items()}
        columns["terminated"] = ends & (np.arange(steps) == steps - 1)
        episodes[where] = columns
    note = f"{counted(early, 'step')} done before the end of a demo: the episode goes on there"
    environment, rate = "", 0.0
    with suppress(ValueError, TypeError, KeyError, AttributeError):
        known = json.loads(env_args)
        environment = str(known["env_name"])
        rate = float(known["env_kwargs"]["control_freq"])
    columns, place = joined(name, episodes)
    return frame_of_arrays(
        name,
        columns,
        label=label_of(environment or Path(name).stem),
        place=place,
        timestep=1 / rate if 0 < rate < math.inf else None,
        layout=Layout(observations=tuple(after) or (_NOW,), actions=("actions",)),
        after=after,
        about=_about(columns),
        notes=(note,) if early else (),
    )


def _column(name: str, others: Collection[str]) -> str:
    """What an array of a demo is called: as robomimic calls what is observed, if nothing else is.

    What was done before, `obs/actions`, isn't what is done then, `actions`.
    """
    short = name.removeprefix(_NOW)
    return name if short in others else short


def _about(arrays: Mapping[str, Array]) -> dict[str, About]:
    """The numbers of arrays in groups are named without the group."""
    about = dict[str, About]()
    for name, each in arrays.items():
        short, size = name.rpartition("/")[2], math.prod(each.shape[1:])
        names = [short] if size == 1 else [f"{short}_{i}" for i in range(size)]
        about |= {name: About(names=tuple(names))} if short != name else {}
    return about
