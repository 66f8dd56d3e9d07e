"""Give a code features, and take them from others: python tools/ablate.py STUDY OUT.

For ablation or ablation-speed in studies/, from encoders that ship: dae-8 with features beside it;
the full observation and forward-8 without one.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jbrep.encoders import FULL, Encoder, find, save
from jbrep.encoders.encoder import SUFFIX
from jbrep.encoders.header import IMPORTED, EncoderHeader
from jbrep.encoders.layers import Layer
from jbrep.envs import describe

FEATURES = {
    "yaw-rate": "angular_velocity_z",
    "height": "position_z",
    "speed": "velocity_in_target_frame_x",
}


class Ablation(NamedTuple):
    """What a study asks."""

    tasks: Sequence[str]
    taken: str  # from the full observation and from forward-8
    given: Sequence[Sequence[str]]  # to dae-8


STUDIES = {
    "ablation": Ablation(
        ("face_direction", "move_in_direction"), "yaw-rate", [["yaw-rate"], ["height"]]
    ),
    "ablation-speed": Ablation(["move_in_direction"], "speed", [["speed"], ["speed", "yaw-rate"]]),
}


def given(encoder: Encoder, features: Sequence[str]) -> Encoder:
    """The code with scaled features as more numbers."""
    name = f"{encoder.name}-with-{'-and-'.join(features)}"
    keep = tuple(FEATURES[each] for each in features)
    return Encoder(named(encoder, name), encoder.scaler, encoder.encoder, encoder.decoder, keep)


def blinded(encoder: Encoder, name: str, feature: str) -> Encoder:
    """The code of observations in which a feature is always midway in its range."""
    size = encoder.size
    nothing = Layer(np.eye(size, dtype=np.float32), np.zeros(size, np.float32), "linear")
    first, *others = encoder.encoder or (nothing,)
    assert isinstance(first, Layer)  # as jbrep's own methods make them
    weight = first.weight.copy()
    weight[:, encoder.task.feature_names.index(FEATURES[feature])] = 0
    layers = (first._replace(weight=weight), *others)
    decoder = encoder.decoder or (nothing,)
    return Encoder(named(encoder, name), encoder.scaler, layers, decoder, encoder.header.keep)


def named(encoder: Encoder, name: str) -> EncoderHeader:
    """The header of a code that no method has made."""
    return encoder.header.replace(name=name, kind=IMPORTED)


def ablated(study: Ablation, task: str) -> Iterator[Encoder]:
    known = {name: find(name, describe(task)) for name in (FULL, "dae-8", "forward-8")}
    encoders = {name: each for name, each in known.items() if isinstance(each, Encoder)}
    for features in study.given:
        yield given(encoders["dae-8"], features)
    for name in ("forward-8", FULL):
        yield blinded(encoders[name], f"{name}-without-{study.taken}", study.taken)


def main(study: Ablation, out: Path) -> None:
    for task in study.tasks:
        (out / task).mkdir(parents=True, exist_ok=True)
        for encoder in ablated(study, task):
            save(encoder, out / task / f"{encoder.name}{SUFFIX}")
            print(out / task / f"{encoder.name}{SUFFIX}")


if __name__ == "__main__":
    main(STUDIES[sys.argv[1]], Path(sys.argv[2]))
