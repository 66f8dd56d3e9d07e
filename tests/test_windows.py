"""Windows of steps: within episodes, without copies; training on them, resumed."""

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensors import torch_threads
from wide import wide

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.fit import Fitter
from jbrep.methods.passes import blocks
from jbrep.training.trainer import Trainer
from jbrep.training.windows import Windows

LENGTHS = [1, 30, 2, 12, 1, 7, 40, 21, 1, 22]


@pytest.fixture(scope="module")
def data():
    made = wide(LENGTHS, features=6)
    rewards = np.random.default_rng(1).normal(size=sum(LENGTHS)).astype(np.float32)
    made.dataset.arrays["reward"] = rewards
    made.dataset.episodes["final_observation"] = np.random.default_rng(2).normal(size=(10, 6))
    made.dataset.episodes["terminated"] = np.zeros(10, bool)
    return made


def within(data, horizon):
    """Rows of the training part that have so many more in their episode, one by one."""
    ends = np.cumsum(LENGTHS)
    return [row for row in data.train if row + horizon < ends[np.sum(ends <= row)]]


@pytest.mark.parametrize("horizon", [0, 6, 20])
def test_windows_lie_within_episodes_and_have_the_data_sets_numbers(data, horizon):
    windows = Windows(data, data.train, horizon)
    first = np.array(within(data, horizon))
    assert len(windows) == len(first)
    order = np.random.default_rng(0).permutation(len(first))
    numbers, rows = torch.from_numpy(order), first[order]
    arrays = data.dataset.arrays
    for ahead in {0, horizon}:
        expected = data.scale(arrays["observation"][rows + ahead])
        np.testing.assert_array_equal(windows.rows(numbers, ahead), expected)
    if horizon:
        steps = rows[:, None] + np.arange(horizon)
        actions = windows.actions(numbers, horizon)
        np.testing.assert_allclose(actions, arrays["action"][steps], atol=1e-6)
        mean = data.rewards(steps).mean(axis=1, dtype=float)
        assert np.ptp(arrays["reward"][steps].mean(axis=1) / mean) < 1e-4  # in another unit
        np.testing.assert_allclose(windows.rewards(numbers, horizon), mean, atol=1e-6)


def test_the_last_step_of_an_episode_leads_to_its_final_observation(data):
    windows, lasts = Windows(data, data.train), np.cumsum(LENGTHS) - 1
    own = np.isin(lasts, data.train)
    finals = data.scale(data.dataset.episodes["final_observation"][own])
    following = windows.steps(windows.numbers)[2][np.searchsorted(data.train, lasts[own])]
    np.testing.assert_allclose(following, finals, rtol=1e-5)


def test_a_horizon_that_no_episode_has_is_refused(data):
    for look in (lambda: Windows(data, data.train, 40), lambda: next(blocks(data, 40, 1, 1))):
        with pytest.raises(
            InputError, match=r"no training episode of .* has more than 40 steps: look fe"
        ):
            look()


def test_forward_is_the_same_stopped_and_on_more_threads(collected, tmp_path, monkeypatch):
    data = ScaledDataset(Dataset(collected))
    how = {"latent": 4, "architecture": "linear", "horizons": "1,5", "epochs": 3, "batch_size": 500}
    whole = Fitter(data, tmp_path / "whole").fit("forward", **how).path.read_bytes()
    save, saved = Trainer.save, []

    def stopping(*given):
        save(*given)
        saved.append(given)
        if len(saved) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "save", stopping)
    fitter = Fitter(data, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt):
        fitter.fit("forward", **how)
    with torch_threads(2):
        resumed = fitter.fit("forward", **how)
    assert resumed.is_new
    assert resumed.path.read_bytes() == whole
    events = EventAccumulator(str(resumed.path.with_suffix(".training"))).Reload()
    for name in ("train_loss", "test_loss"):
        assert [event.step for event in events.Scalars(name)] == [1, 2, 3]
