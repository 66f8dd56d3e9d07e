"""What codes are made to predict: changes and values of scaled rows to come, and rewards."""

import math

import numpy as np

from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaling import wrapped
from jbrep.errors import InputError
from jbrep.methods.method import Settings
from jbrep.methods.passes import Array

PARTS = ("changes", "values", "reward")  # settings with the weights of targets, in their order


def check_targets(
    data: ScaledDataset, settings: Settings, kind: str, others: tuple[str, ...] = ()
) -> None:
    """Make sure that there is something to predict.

    Args:
        data: to learn from.
        settings: of the method.
        kind: the method's name.
        others: settings with weights of other targets.

    Raises:
        InputError: there isn't: all weights are 0, or all but that of a constant reward.
    """
    weighted = [name for name in (*PARTS, *others) if settings[name]]
    if not weighted:
        raise InputError(f"{kind} has nothing to predict: all its weights are 0")
    if weighted == ["reward"] and not data.reward_varies:
        raise nothing_varies(data, kind)


def nothing_varies(data: ScaledDataset, kind: str) -> InputError:
    """The mistake of predicting what is constant."""
    return InputError(
        f"nothing that {kind} is to predict varies in {data.dataset.folder}: give other targets a "
        "weight above 0"
    )


def turns(data: ScaledDataset) -> Array:
    """The length of a full turn of each scaled number that is an angle, (size,); else infinite."""
    coded = set(data.scaler.angles)
    whole = [
        2 * math.pi / data.scaler.half_width[i]
        if i < data.task.size and i not in coded and data.task.features[i].is_angle
        else math.inf
        for i in data.used
    ]
    return np.array(whole)


def change(now: Array, then: Array, turn: Array) -> Array:
    """What scaled rows change by, (m, size); angles take the shorter way."""
    difference = then - now
    angles = np.isfinite(turn)
    unit = turn[angles] / (2 * math.pi)
    difference[:, angles] = wrapped(difference[:, angles] / unit) * unit
    return difference
