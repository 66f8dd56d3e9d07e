"""The autoencoder's relatives: the authors' other encoders, weights, presets, what is kept."""

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal, kl_divergence

from jbrep.dae import DAE
from jbrep.encoders.layers import run
from jbrep.methods import vae
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import METHODS, name_of, read_name
from jbrep.methods.vae import cross_entropy, posterior
from jbrep.training.trainer import Trainer
from jbrep.training.windows import Windows

# Epochs and learning rate for 4,000 rows, and the R^2 that must be passed
RELATIVES = {"ddae": (10, 3e-2, 0.7), "vae": (10, 1e-2, 0.7), "lld-vae": (12, 5e-3, 0.4)}


def objective(data, kind, **changes):
    return METHODS[kind].of({"latent": 8, **changes}).objective(data)


def trainer(data, kind, epochs=2, learning_rate=1e-3, batch_size=250, **changes):
    how = {"epochs": epochs, "learning_rate": learning_rate, "batch_size": batch_size}
    method = METHODS[kind].of({"latent": 8, **how, **changes})
    it = method.objective(data)
    parts = (Windows(data, rows, it.horizon) for rows in (data.train, data.test))
    return Trainer(it, method, *parts)


@pytest.mark.parametrize("kind", RELATIVES)
def test_relatives_learn_to_reconstruct(kind, data, tmp_path):
    epochs, rate, least = RELATIVES[kind]
    settings = {"latent": 8, "epochs": epochs, "learning_rate": rate, "batch_size": 100}
    encoder, path, *_ = Fitter(data, tmp_path).fit(kind, **settings)
    assert path.name == f"{kind}-8.safetensors"
    assert read_name(f"{kind}-8")[0] is METHODS[kind]
    rows = data.dataset["observation"][data.train]
    assert encoder(rows).shape == (4000, 8)
    rows, back = data.scale(rows), data.scale(encoder.decode(encoder(rows)))
    assert 1 - np.square(back - rows).mean() / rows.var(axis=0).mean() > least


@pytest.mark.parametrize("kind", ["dae", "ddae", "lld-vae", "forward", "deepmdp"])
def test_the_same_seed_gives_the_same_weights_also_after_a_resume(kind, data, tmp_path):
    one, other, half = (trainer(data, kind) for _ in range(3))
    list(one.epochs())
    next(half.epochs())
    assert one.history[1].train_loss < one.history[0].train_loss
    half.save({}, tmp_path / "at")
    other.restore({}, tmp_path / "at")
    list(other.epochs())
    assert other.history == one.history
    assert all(torch.equal(one.best[name], other.best[name]) for name in one.best)
    for name, parameter in one.objective.state_dict().items():
        assert torch.equal(other.objective.state_dict()[name], parameter)


@pytest.mark.parametrize("kind", ["vae", "lld-vae"])
def test_codes_are_drawn_in_training_and_means_in_evaluation(kind, data):
    it, windows = objective(data, kind), Windows(data, data.train, 1)
    numbers = torch.arange(6)
    drawn = [
        list(it.draws(windows, numbers, 4, torch.Generator().manual_seed(seed)))
        for seed in (0, 0, 1)
    ]
    assert [len(batch[0]) for batch in drawn[0]] == [4, 2]
    noise = [torch.cat([batch[-1] for batch in batches]) for batches in drawn]
    assert torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0], noise[2])
    assert not it.batch(windows, numbers)[-1].any()
    encoder, _ = it.layers()
    rows = windows.rows(numbers)
    mean, _ = posterior(it.encoder(rows))
    np.testing.assert_allclose(run(encoder, rows.numpy()), mean.detach(), rtol=1e-4, atol=1e-6)


def test_the_transition_is_the_identity_and_a_product_of_vectors(data):
    it = objective(data, "lld-vae").double()
    random = torch.Generator().manual_seed(0)
    code, mean, after, log_deviation, log_after = torch.randn(
        (5, 7, 8), generator=random, dtype=torch.float64
    )
    with torch.no_grad():
        left, right, shift = it.step(code, torch.ones(7, 1).double())
        _, _, still = it.step(code, torch.zeros(7, 1).double())
    matrix = torch.eye(8) + left[:, :, None] * right[:, None]
    torch.testing.assert_close(vae.moved(code, left, right), (matrix @ code[:, :, None])[:, :, 0])
    assert not torch.equal(shift, still)  # the action moves it
    spread = matrix @ torch.diag_embed((2 * log_deviation).exp()) @ matrix.mT
    expected = kl_divergence(
        MultivariateNormal(mean, spread),
        MultivariateNormal(after, torch.diag_embed((2 * log_after).exp())),
    )
    ours = vae.transition_divergence(mean, log_deviation, left, right, after, log_after)
    torch.testing.assert_close(ours, expected)


def test_a_sigmoid_has_targets_within_its_range():
    rows = torch.tensor([[-3.0, -1, 0, 1, 3]])
    best = torch.tensor([[-40.0, -40, 0, 40, 40]])
    lost = cross_entropy(best, rows, None)
    torch.testing.assert_close(lost, torch.tensor([[0, 0, np.log(2), 0, 0]], dtype=torch.float32))
    weighted = cross_entropy(best, rows, torch.tensor([1.0, 1, 3, 1, 1]))
    torch.testing.assert_close(weighted, 3 * lost)


def test_ddae_looks_ahead_in_its_episode_and_then_has_a_linear_decoder(data):
    it = objective(data, "ddae", ahead=20)
    windows = Windows(data, data.train, it.horizon)
    assert len(windows) == 4 * (1000 - 20)
    now, later = it.batch(windows, torch.tensor([979, 980]))  # the last of one, the first of two
    expected = torch.from_numpy(data.load(data.train[[979, 1000, 999, 1020]]))
    torch.testing.assert_close(torch.cat((now, later)), expected)
    assert it.layers()[1] is None
    assert [it.rate(0, step) for step in (999, 1000, 2500)] == [1, 0.96, 0.96**2]


def test_a_weighted_feature_is_reconstructed_better(data, tmp_path):
    fitter = Fitter(data, tmp_path)
    settings = {"latent": 4, "epochs": 10, "batch_size": 100, "learning_rate": 1e-2}
    place = data.names.index("velocity_x")
    plain = fitter.fit("ae", **settings).encoder
    weighted = fitter.fit("ae", name="w", weights="velocity_x=30", **settings).encoder
    assert weighted.header.training["weights"] == {"velocity_x": 30}
    rows = data.dataset["observation"][data.test]
    lost = [np.square(it.decode(it(rows)) - rows).mean(axis=0)[place] for it in (plain, weighted)]
    assert lost[1] < lost[0] / 2


def test_the_authors_begin_with_normal_weights_and_shake_a_batch_as_one(data):
    preset = DAE.presets["authors"]
    used = DAE(latent=12, **preset)
    assert name_of(used) == "dae-authors-12"
    for change in ("initial", "shared_noise"):  # each alone is another encoder than both
        assert name_of(DAE(latent=12, **{change: preset[change]})) == "dae-12"
    it = used.objective(data)
    weights = torch.cat([stack[0].weight.detach().flatten() for stack in (it.encoder, it.decoder)])
    assert len(weights) == 2 * 12 * 16
    assert abs(weights.mean()) < 0.15
    assert weights.std() == pytest.approx(1, abs=0.1)
    assert not it.encoder[0].bias.any()
    assert not it.decoder[0].bias.any()
    windows = Windows(data, data.train)
    batches = it.draws(windows, torch.arange(200), 100, torch.Generator().manual_seed(0))
    noise = [corrupted - clean for corrupted, clean in batches]
    for each in noise:
        torch.testing.assert_close(each, each[:, :1].expand(-1, 100), rtol=0, atol=1e-6)
    assert not torch.equal(noise[0][:, 0], noise[1][:, 0])
    assert 0.05 < torch.cat(noise)[:, 0].std() < 0.2
