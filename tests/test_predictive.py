"""Codes that are learned from what comes next."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensors import torch_threads
from wide import WideDataset, make_feature, make_task, wide

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.errors import InputError
from jbrep.methods.fit import Fitter
from jbrep.methods.forward import Forward
from jbrep.methods.linear import principal_code
from jbrep.methods.passes import blocks
from jbrep.methods.registry import get_method
from jbrep.training.trainer import Trainer
from jbrep.training.windows import Windows

NOISY = 4  # features that nothing predicts
TURN = 0.3  # [rad] of the hidden state in a step


class HiddenDataset(WideDataset):
    """A Dataset of two hidden numbers, which turn and which the action pushes, among noise."""

    def __init__(self, episodes, length):
        count = episodes * length
        task = make_task([make_feature(f"obs_{i}") for i in range(2 + NOISY)])
        random = np.random.default_rng(0)
        actions = random.uniform(-1, 1, (length, episodes))
        turn = 0.95 * np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
        hidden = np.empty((length, episodes, 2))
        hidden[0] = random.normal(size=(episodes, 2))
        for before, after in pairwise(range(length)):
            hidden[after] = hidden[before] @ turn.T
            hidden[after, :, 0] += actions[before]
        rows = hidden.transpose(1, 0, 2).reshape(count, 2)
        noise = random.uniform(-1, 1, (count, NOISY))
        self.hidden, self.folder, self.task = rows, "made-up", task
        task.__dict__.update(action_low=(-1.0,), action_high=(1.0,))
        self.episodes = {"length": np.full(episodes, length), "seed": np.arange(episodes)}
        self.manifest = SimpleNamespace(settings=SimpleNamespace(unrewarded=False))
        self.fingerprint = "made-up"
        self.arrays = {
            "observation": np.hstack((rows @ [[1, 0.5], [-0.5, 1]], noise)).astype(np.float32),
            "action": actions.T.reshape(count, 1).astype(np.float32),
            "reward": rows[:, 0].astype(np.float32),
        }


@pytest.fixture(scope="module")
def hidden():
    return ScaledDataset(HiddenDataset(30, 200))


def train(data, kind, epochs, **settings):
    """A trained objective and the history of its losses."""
    how = {"latent": 2, "learning_rate": 5e-3, "epochs": epochs, "batch_size": 200}
    method = get_method(kind).of({**how, **settings})
    objective = method.objective(data)
    windows, watched = (Windows(data, r, objective.horizon) for r in (data.train, data.test))
    trainer = Trainer(objective, method, windows, watched)
    for _ in trainer.epochs():
        pass
    return objective.eval(), trainer.history


def explained(code, wanted):
    """R^2 of wanted (n, k) from codes (n, l), by a linear map."""
    regressors = np.column_stack((code, np.ones(len(code))))
    residual = wanted - regressors @ np.linalg.lstsq(regressors, wanted, rcond=None)[0]
    return 1 - residual.var(axis=0) / wanted.var(axis=0)


@pytest.mark.parametrize("kind", ["forward", "self-prediction", "deepmdp"])
def test_every_parameter_learns_and_the_loss_falls(data, kind):
    settings = {"inverse": 0.5, "horizons": (1, 5)} if kind == "forward" else {}
    objective, history = train(data, kind, 4, latent=3, **settings)
    assert history[-1].train_loss < 0.8 * history[0].train_loss
    windows = Windows(data, data.train, objective.horizon)
    objective.gradient(objective.batch(windows, windows.numbers[:500]))
    still = [name for name, p in objective.named_parameters() if not p.grad.abs().sum() > 0]
    assert not still


def test_targets_of_the_forward_code_stay_within_an_episode(data):
    objective = Forward(latent=2, horizons=(2, 7)).objective(data)
    windows = Windows(data, data.train, 7)
    batch = objective.batch(windows, windows.numbers)  # not yet standardised
    length = data.dataset.episodes["length"][0]
    assert len(windows) == len(data.train) - 7 * len(data.train) // length
    last, first = length - 8, length - 7  # the last window of an episode, the first of the next
    angle = data.names.index("angle_to_target")
    for window, start in ((last, length - 8), (first, length)):
        places = data.train[start : start + 8]
        rows, rewards = data.load(places), data.dataset["reward"][places]
        np.testing.assert_array_equal(batch.now[:, window], rows[0])
        np.testing.assert_array_equal(batch.after[:, window], rows[1])
        np.testing.assert_allclose(
            batch.actions[:, window], data.dataset["action"][places[:-1]][:, 0], rtol=1e-6
        )
        for targets, ahead in zip(batch.targets[..., window], (2, 7), strict=True):
            change = rows[ahead] - rows[0]
            change[angle] = (change[angle] + 1) % 2 - 1
            expected = [*change, *rows[ahead], rewards[:ahead].mean()]
            np.testing.assert_allclose(targets, expected, atol=1e-5)


@pytest.mark.parametrize("weights", [{"reward": 1, "values": 1}, {"inverse": 1}])
def test_forward_finds_what_the_action_moves_among_noise(hidden, weights):
    used = {**dict.fromkeys(("changes", "values", "reward", "inverse"), 0), **weights}
    objective, history = train(
        hidden, "forward", 15, architecture="linear", horizons=(1, 5), **used
    )
    rows, wanted = hidden.load(hidden.test), hidden.dataset.hidden[hidden.test]
    with torch.no_grad():
        code = objective.encoder(torch.from_numpy(rows)).numpy()
        report = objective.report(Windows(hidden, hidden.test, 5))["loss_by_horizon"]
    assert (explained(code, wanted) > 0.97).all()
    ((weight, bias, _),), _ = principal_code(hidden, 2)
    assert (explained(rows @ weight.T + bias, wanted) < 0.5).any()
    assert set(report["1"]) == {name for name, weight in weights.items() if name != "inverse"}
    if not used["inverse"]:
        noise = NOISY / (2 + NOISY)  # the share of the features that can't be predicted
        assert report["1"]["values"] == pytest.approx(noise, abs=0.1)
        said = [each["values"] + each["reward"] for each in report.values()]
        assert history[-1].test_loss == pytest.approx(np.mean(said), rel=1e-4)


def test_what_is_constant_counts_as_nothing_predicted():
    """One of four features here: no prediction loses 1 of the others, not 3/4 of all."""
    data = wide([100] * 40, features=4)
    objective = get_method("forward").of({"latent": 2, "reward": 0.0}).objective(data)
    windows = Windows(data, data.test, objective.horizon)
    objective.prepare(windows)
    for last in (objective.predictors.weights[-1], objective.predictors.biases[-1]):
        last.data.zero_()
    with torch.no_grad():
        by_horizon = objective.report(windows)["loss_by_horizon"]
    for lost in by_horizon.values():
        assert lost["changes"] == pytest.approx(1, abs=0.1)


def test_a_self_predicting_code_has_a_mean_magnitude_of_1(data, tmp_path):
    encoder = Fitter(data, tmp_path).fit("self-prediction", latent=4, epochs=2).encoder
    code = encoder.encode(data.dataset["observation"][:])
    np.testing.assert_allclose(np.abs(code).mean(axis=1), 1, rtol=1e-5)
    assert code.std(axis=0).mean() > 0.1  # it isn't constant
    assert encoder.can_decode


def test_deepmdp_keeps_its_functions_smooth(data):
    slopes = []
    for weight in (0, 10):
        objective, _ = train(data, "deepmdp", 4, lipschitz=weight, latent=3)
        with torch.no_grad():
            bound = float(objective.lipschitz(objective.reward))
            first, second = 2 * torch.rand(2, 5000, 4) - 1
            second[:, 3:] = first[:, 3:]  # the same action
            difference = objective.reward(first) - objective.reward(second)
            slope = float((difference.norm(dim=1) / (first - second).norm(dim=1)).max())
        assert slope <= bound
        slopes.append(bound)
    assert slopes[0] > 1.5
    assert slopes[1] < 1.1


def test_settings_that_cannot_be_are_refused(data, tmp_path):
    for kind, settings in (
        ("forward", {"changes": 0, "values": 0, "reward": 0}),
        ("forward", {"horizons": "1,1000"}),
        ("self-prediction", {"latent": 1}),
        ("deepmdp", {"reward": 0}),
    ):
        with pytest.raises(InputError):
            Fitter(data, tmp_path / "out").fit(kind, **{"latent": 3, **settings})
    assert not list(tmp_path.glob("out/*.safetensors"))


@pytest.mark.parametrize(
    ("kind", "weights"),
    [
        ("deepmdp", {}),
        ("forward", {"changes": 0, "values": 0}),
        ("linear-forward", {"changes": 0, "values": 0}),
    ],
)
def test_a_constant_reward_is_no_target(kind, weights, tmp_path):
    dataset = HiddenDataset(3, 30)
    dataset.arrays["reward"][:] = 0.1
    with pytest.raises(InputError, match=f"{kind}.*varies"):
        Fitter(ScaledDataset(dataset), tmp_path).plan(kind, latent=2, **weights)


LENGTHS = [1, 30, 2, 12, 1, 7, 40, 21, 1, 22]


@pytest.fixture(scope="module")
def walks():
    made = wide(LENGTHS, features=6)
    rewards = np.random.default_rng(1).normal(size=sum(LENGTHS)).astype(np.float32)
    made.dataset.arrays["reward"] = rewards
    made.dataset.episodes["final_observation"] = np.random.default_rng(2).normal(size=(10, 6))
    made.dataset.episodes["terminated"] = np.zeros(10, bool)
    return made


@pytest.mark.parametrize("horizon", [0, 6, 20])
def test_windows_lie_within_episodes_and_have_the_data_sets_numbers(walks, horizon):
    windows = Windows(walks, walks.train, horizon)
    ends = np.cumsum(LENGTHS)
    first = [row for row in walks.train if row + horizon < ends[np.sum(ends <= row)]]
    assert len(windows) == len(first)
    order = np.random.default_rng(0).permutation(len(first))
    numbers, rows = torch.from_numpy(order), np.array(first)[order]
    arrays = walks.dataset.arrays
    for ahead in {0, horizon}:
        expected = walks.scale(arrays["observation"][rows + ahead])
        np.testing.assert_array_equal(windows.rows(numbers, ahead), expected)
    if horizon:
        steps = rows[:, None] + np.arange(horizon)
        actions = windows.actions(numbers, horizon)
        np.testing.assert_allclose(actions, arrays["action"][steps], atol=1e-6)
        mean = walks.rewards(steps).mean(axis=1, dtype=float)
        assert np.ptp(arrays["reward"][steps].mean(axis=1) / mean) < 1e-4  # in another unit
        np.testing.assert_allclose(windows.rewards(numbers, horizon), mean, atol=1e-6)


def test_the_last_step_of_an_episode_leads_to_its_final_observation(walks):
    windows, lasts = Windows(walks, walks.train), np.cumsum(LENGTHS) - 1
    own = np.isin(lasts, walks.train)
    finals = walks.scale(walks.dataset.episodes["final_observation"][own])
    following = windows.steps(windows.numbers)[2][np.searchsorted(walks.train, lasts[own])]
    np.testing.assert_allclose(following, finals, rtol=1e-5)


def test_a_horizon_that_no_episode_has_is_refused(walks):
    for look in (lambda: Windows(walks, walks.train, 40), lambda: next(blocks(walks, 40, 1, 1))):
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
