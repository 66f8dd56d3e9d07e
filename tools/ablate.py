"""Give a code one feature, and take it from others: python tools/ablate.py OUT.

For each task of studies/ablation.toml, from encoders that ship: dae-8 with the rate of yaw beside
it, and with the height beside it instead; the full observation and forward-8 without rate of yaw.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.encoders import FULL, Encoder, find, save
from jbrep.encoders.encoder import IMPORTED, Layer
from jbrep.encoders.file import SUFFIX
from jbrep.envs import describe

TASKS = ("face_direction", "move_in_direction")
LACKING, OTHER = "angular_velocity_z", "position_z"


def given(encoder: Encoder, feature: str, name: str) -> Encoder:
    """The code with a scaled feature as one more number."""
    return replace(encoder, header=named(encoder, name), keep=(feature,))


def blinded(encoder: Encoder, feature: str, name: str) -> Encoder:
    """The code of observations in which a feature is always midway in its range."""
    size = encoder.size
    nothing = Layer(np.eye(size, dtype=np.float32), np.zeros(size, np.float32), "linear")
    first, *others = encoder.encoder or (nothing,)
    weight = first.weight.copy()
    weight[:, encoder.feature_names.index(feature)] = 0
    layers = (first._replace(weight=weight), *others)
    decoder = encoder.decoder or (nothing,)
    return replace(encoder, header=named(encoder, name), encoder=layers, decoder=decoder)


def named(encoder: Encoder, name: str) -> dict[str, Any]:
    """The header of a code that no method has made."""
    return {**encoder.header, "name": name, "kind": IMPORTED}


def ablations(task: str) -> Iterator[Encoder]:
    known = {name: find(name, describe(task)) for name in (FULL, "dae-8", "forward-8")}
    encoders = {name: each for name, each in known.items() if isinstance(each, Encoder)}
    yield given(encoders["dae-8"], LACKING, "dae-8-with-yaw-rate")
    yield given(encoders["dae-8"], OTHER, "dae-8-with-height")
    yield blinded(encoders["forward-8"], LACKING, "forward-8-without-yaw-rate")
    yield blinded(encoders[FULL], LACKING, "full-without-yaw-rate")


def main(out: Path) -> None:
    for task in TASKS:
        (out / task).mkdir(parents=True, exist_ok=True)
        for encoder in ablations(task):
            save(encoder, out / task / f"{encoder.name}{SUFFIX}")
            print(out / task / f"{encoder.name}{SUFFIX}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
