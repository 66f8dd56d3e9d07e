"""Logs of which everything is known are read back to the number, in whatever form they come."""

import numpy as np
import pytest
from drawn import FILES, Truth, frame
from foreign import imported

from jbrep.dataset import Layout, from_table

COUNTS = {"text": 40, "bag": 9}


@pytest.mark.parametrize("form", FILES)
def test_files_are_read_back(form, tmp_path):
    for seed in range(COUNTS.get(form, 6)):
        random = np.random.default_rng(seed)
        truth, folder = Truth.drawn(random), tmp_path / str(seed)
        folder.mkdir()
        path, options, lacks = FILES[form](truth, random, folder / "log")
        _, data = imported(path, *options)
        truth.check(data, **lacks)


def test_frames_are_read_back(tmp_path):
    for seed in range(12):
        random = np.random.default_rng(seed)
        truth = Truth.drawn(random)
        names = {"observations": tuple(truth.features), "actions": tuple(truth.commands)}
        layout = Layout(**names, time="t", episode="trial", reward="gain")
        truth.check(from_table(tmp_path / str(seed), frame(truth, random), layout))
