"""The container of encoders and checkpoints: whatever changes in one is noticed."""

import numpy as np
import pytest
import torch
from small import ONE_EACH, flip_bit
from tensors import TensorWindows

from jbrep.dae import DAE
from jbrep.dae.autoencoder import Reconstruction
from jbrep.errors import DamageError
from jbrep.records import container
from jbrep.rl import Run, Session, train
from jbrep.rl.files import CHECKPOINT
from jbrep.training import checkpoint
from jbrep.training.trainer import Schedule, Trainer

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


def test_a_changed_bit_in_a_checkpoint_of_an_encoder_is_noticed(tmp_path):
    rows = TensorWindows(torch.from_numpy(RANDOM.normal(size=(60, 16)).astype(np.float32)))
    network = Reconstruction(DAE(latent=4), 16)
    how = Schedule(epochs=2, batch_size=30, learning_rate=1e-3)
    trainer = Trainer(network, how, rows, rows)
    next(trainer.epochs())
    path = tmp_path / "at"
    checkpoint.save(trainer, {}, path)
    whole = path.read_bytes()
    for bit in bits_of_tensors(path, 32):
        flip_bit(path, bit)
        with pytest.raises(DamageError, match=r"at is damaged .*: delete it to start over"):
            checkpoint.restore(trainer, {}, path)
        path.write_bytes(whole)
    checkpoint.restore(trainer, {}, path)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that has written a checkpoint, and the folder that has it."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    run = Run.of(task="face_direction", algorithm="a2c", steps=40, preset="paper", **ONE_EACH)

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
