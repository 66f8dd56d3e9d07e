"""The container of encoders and checkpoints: whatever changes in one is noticed."""

import numpy as np
import pytest
from small import ONE_EACH, flip_bit

from jbrep.envs import describe
from jbrep.errors import DamageError
from jbrep.records import container
from jbrep.rl import Run, Session, train
from jbrep.rl.files import CHECKPOINT

RANDOM = np.random.default_rng(0)


def bits_of_tensors(path, count):
    content = path.read_bytes()
    start = 8 * (8 + int.from_bytes(content[:8], "little"))
    return RANDOM.integers(start, 8 * len(content), count)


def test_what_is_written_is_read_back(tmp_path):
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
    assert (tmp_path / "again").read_bytes() == (tmp_path / "it").read_bytes()


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that has written a checkpoint, and the folder that has it."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    run = Run.of(
        task=describe("face_direction", episode_steps=50),
        algorithm="a2c",
        steps=40,
        preset="paper",
        **ONE_EACH,
    )

    def watch(job, step):
        if (folder / CHECKPOINT).exists():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(run, folder, Session(watch, save_every=0))
    return run, folder


def test_a_changed_bit_in_a_checkpoint_of_a_run_is_noticed(stopped):
    run, folder = stopped
    path = folder / CHECKPOINT
    whole = path.read_bytes()
    for bit in bits_of_tensors(path, 32):
        flip_bit(path, bit)
        with pytest.raises(DamageError, match="is damaged"):
            container.read(path, "checkpoint")
        path.write_bytes(whole)
    flip_bit(path, 8 * len(whole) - 1)
    with pytest.raises(DamageError, match=r"is damaged .*: delete it to start over"):
        train(run, folder)
