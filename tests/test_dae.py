"""The denoising autoencoder: gradient, corruption, training, checkpoints."""

from itertools import chain

import numpy as np
import pytest
import torch
from tensors import TensorWindows, torch_threads
from torch.nn.functional import mse_loss

from jbrep.dae import DAE, Gradient, Reconstruction
from jbrep.encoders.layers import run
from jbrep.errors import InputError
from jbrep.training.network import ARCHITECTURES, layers, stacks
from jbrep.training.trainer import Trainer


def rows(count=600, size=16, seed=0):
    """Rows near a plane of 4 dimensions."""
    random = np.random.default_rng(seed)
    plane = random.normal(size=(4, size)) / 4
    return torch.from_numpy((random.normal(size=(count, 4)) @ plane).astype(np.float32))


def trainer(train=None, latent=4, architecture="paper", noise=0.1, seed=0, **how):
    train = rows() if train is None else train
    how = {"epochs": 3, "batch_size": 100, "learning_rate": 3e-3, **how}
    method = DAE(latent=latent, architecture=architecture, seed=seed, **how)
    objective = Reconstruction(method, train.shape[1], noise=noise)
    windows, watched = TensorWindows(train), TensorWindows(train[:50])
    return Trainer(objective, method, windows, watched)


def trained(**changes):
    it = trainer(**changes)
    list(it.epochs())
    return it


def weights(it):
    return torch.cat([p.detach().flatten() for p in it.objective.parameters()])


@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize(("count", "weights"), [(64, None), (37, None), (64, torch.arange(16.0))])
def test_the_gradient_is_autograds(architecture, count, weights):
    it = Reconstruction(DAE(latent=5, architecture=architecture), 16, weights)
    batch = rows(count, seed=1).T, rows(count, seed=2).T
    loss = it.loss(batch)
    if weights is None:
        torch.testing.assert_close(loss, mse_loss(it.decoder(it.encoder(batch[0].T)), batch[1].T))
    expected = torch.autograd.grad(loss, list(it.parameters()))
    gradient = Gradient((*it.encoder, *it.decoder), 64, weights)
    for _ in range(2):  # nothing is left over from the first
        assert gradient(*batch).item() == pytest.approx(loss.item(), rel=1e-5)
        for parameter, wanted in zip(it.parameters(), expected, strict=True):
            torch.testing.assert_close(parameter.grad, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_layers_give_what_the_network_gives(architecture):
    parts, values = stacks(ARCHITECTURES[architecture], 16, 5, seed=0), rows(9)
    expected = parts[1](parts[0](values)).detach()
    parts = (*layers(parts[0]), *layers(parts[1]))
    np.testing.assert_allclose(run(parts, values.numpy()), expected, rtol=1e-4, atol=1e-6)


def drawn(it, epoch):
    """All corrupted and clean rows of an epoch, in its order."""
    batches = list(chain.from_iterable(it._draws(epoch)))
    assert [clean.shape[1] for _, clean in batches] == [100] * 20
    return (torch.cat(part, 1).T for part in zip(*batches, strict=True))


def test_every_row_comes_once_with_noise_of_its_own():
    data = rows(2000)
    it = trainer(data, noise=0.3)
    corrupted, clean = drawn(it, 1)
    _, again = drawn(it, 2)
    assert not torch.equal(clean, again)
    order = [c.sum(1).sort().values for c in (clean, again, data)]
    torch.testing.assert_close(order[0], order[2])
    torch.testing.assert_close(order[1], order[2])
    noise = (corrupted - clean).numpy()
    assert noise.std() == pytest.approx(0.3, rel=0.02)
    assert abs(noise.mean()) < 0.01
    across = np.corrcoef(noise.T) - np.eye(16)
    assert np.abs(across).max() < 0.1  # features
    assert abs(np.corrcoef(noise[:-1].ravel(), noise[1:].ravel())[0, 1]) < 0.02  # samples
    assert len(np.unique(noise.round(6))) > 25_000
    assert abs(np.corrcoef(noise[:, 0], clean[:, 0])[0, 1]) < 0.1


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_training_comes_near_the_bound_of_linear_codes(architecture):
    data = rows(3000)
    it = trained(train=data, architecture=architecture, epochs=40, noise=0.01)
    assert it.history[-1].train_loss < it.history[0].train_loss / 5
    assert it.history[-1].test_loss < 0.1 * data.square().mean().item()


def test_the_same_seed_gives_the_same_weights_whatever_the_threads():
    one = weights(trained(seed=1))
    torch.manual_seed(99)  # what the caller drew must not matter
    with torch_threads(2):
        assert torch.equal(one, weights(trained(seed=1)))
        assert torch.get_num_threads() == 2
    assert not torch.equal(one, weights(trained(seed=2)))


def test_the_best_epoch_is_that_of_the_lowest_training_loss():
    it = trainer(learning_rate=0.5, epochs=6)
    states = []
    for _ in it.epochs():
        states.append({n: p.clone() for n, p in it.objective.state_dict().items()})
    losses = [epoch.train_loss for epoch in it.history]
    assert it.best_epoch == losses.index(min(losses)) + 1
    for name, value in states[it.best_epoch - 1].items():
        assert torch.equal(it.best[name], value)


def test_losses_that_overflow_end_the_training_and_leave_the_best():
    it = trainer(noise=1e38, architecture="deep", batch_size=600)
    with pytest.raises(InputError, match=r"diverged in epoch 1, .*, or less noise if"):
        list(it.epochs())
    assert all(p.isfinite().all() for p in it.best.values())
