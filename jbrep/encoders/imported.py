"""Encoders that were trained elsewhere."""

from importlib.metadata import version

import numpy as np

from jbrep.dataset import Scaler
from jbrep.encoders.encoder import IMPORTED, Encoder
from jbrep.encoders.layers import Layer
from jbrep.encoders.names import check_name
from jbrep.envs.task import Task
from jbrep.records.record import to_plain


def imported(
    task: Task,
    name: str,
    encoder: tuple[Layer, ...],
    decoder: tuple[Layer, ...],
    package: str,
) -> Encoder:
    """An encoder from layers that take observations in physical units.

    Args:
        task: whose observations it reads.
        name: what tables will call it: lower-case letters, digits and hyphens.
        encoder: from d features to l units.
        decoder: from l units to d features; empty if there is none.
        package: that it comes from, such as torch.

    Raises:
        InputError: an invalid name, or as `Encoder`.
    """
    check_name(name)
    header = {
        "kind": IMPORTED,
        "name": name,
        "task": task.name,
        "environment": to_plain(task),
        "features": list(task.feature_names),
        "training": {},
        "data": {},
        "metrics": {},
        "versions": {each: version(each) for each in ("jbrep", "numpy", package)},
    }
    ones = np.ones(task.size, np.float32)
    return Encoder(header, Scaler(-ones, ones), encoder, decoder)
