"""The container of encoders and checkpoints: whatever changes in one is noticed."""

import numpy as np
import pytest
from small import flip_bit

from jbrep.errors import DamageError
from jbrep.records import container


def test_what_is_written_is_read_back_and_each_changed_bit_of_it_noticed(tmp_path):
    tensors = {
        "transposed": np.arange(6, dtype=np.float32).reshape(2, 3).T,
        "scalar": np.zeros(()),
        "empty": np.zeros((0, 3), np.int64),
        "flags": np.array([True, False]),
    }
    header = {"pair": (1, 2), "nested": {"b": None, "a": 1e-300}}
    container.write(tmp_path / "it", tensors, header)
    given, plain = container.read(tmp_path / "it", "thing")
    assert plain == {"pair": [1, 2], "nested": {"b": None, "a": 1e-300}}
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(given[name], tensor)
        assert given[name].dtype == tensor.dtype
    container.write(tmp_path / "again", given, plain)
    whole = (tmp_path / "it").read_bytes()
    assert (tmp_path / "again").read_bytes() == whole
    for bit in range(8 * len(whole) - 200, 8 * len(whole)):
        flip_bit(tmp_path / "it", bit)
        with pytest.raises(DamageError, match="is damaged"):
            container.read(tmp_path / "it", "thing")
        flip_bit(tmp_path / "it", bit)
