"""Some of the features themselves."""

from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.linear import dense
from jbrep.methods.method import ClosedForm, Made, Settings
from jbrep.methods.settings import REQUIRED


def make(data: ScaledDataset, settings: Settings) -> Made:
    """The scaled numbers of the features, in the observation's order."""
    chosen = [i for i, name in enumerate(data.names) if name in settings["features"]]
    return Made((dense(np.eye(data.size)[chosen], np.zeros(len(chosen))),))


class _Subset(ClosedForm):
    """Patterns are read as the names of the features that match them."""

    def resolve(self, data: ScaledDataset, settings: Settings) -> dict[str, Any]:
        """As for `Method`."""
        names, chosen = data.task.feature_names, set()
        for pattern in settings["features"]:
            matching = [name for name in names if fnmatchcase(name, pattern)]
            if not matching:
                raise InputError(
                    f"no feature {pattern!r}: {data.task.name} has {', '.join(names)}; "
                    "patterns such as velocity_* are understood"
                )
            chosen.update(matching)
        return {**settings, "features": tuple(name for name in names if name in chosen)}


METHOD = _Subset(
    name="subset",
    words="some of the features themselves, scaled",
    own={"features": REQUIRED},
    make=make,
)
