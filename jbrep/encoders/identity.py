"""The identity of a task for which none ships: its observation, scaled where ranges are known."""

import numpy as np

from jbrep.dataset import Scaler
from jbrep.dataset.scaling import usual_range
from jbrep.encoders.encoder import IDENTITY, Encoder
from jbrep.encoders.file import HELD_OUT_MSE
from jbrep.envs.task import Task
from jbrep.records.record import to_plain

SCALINGS = {  # by the word for it in the header
    "ranges": "scaled by the usual ranges",
    "some ranges": "scaled by the usual ranges where they are known",
    "none": "unscaled",
}


def identity(task: Task) -> Encoder:
    """The encoder that leaves a task's observation as it is, but for its scaling.

    The usual range of a feature becomes [-1, 1]; a feature without one keeps its physical units.
    """
    ranges = [usual_range(feature) for feature in task.features]
    known = sum(each is not None for each in ranges)
    low, high = np.array([each or (-1, 1) for each in ranges], np.float32).T
    header = {
        "kind": IDENTITY,
        "name": IDENTITY,
        "task": task.name,
        "environment": to_plain(task),
        "features": list(task.feature_names),
        "training": {
            "scaling": "ranges" if known == task.size else "some ranges" if known else "none"
        },
        "data": {},
        "metrics": {HELD_OUT_MSE: 0.0},
        "versions": {},
    }
    return Encoder(header, Scaler(low, high), (), ())
