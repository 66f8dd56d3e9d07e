"""Slow features, VAMP and the linear forward code against other ways of computing them."""

import math

import numpy as np
import pytest
from deeptime.decomposition import TICA, VAMP
from scipy.linalg import eigh, sqrtm

from jbrep.dataset import ScaledDataset, from_arrays
from jbrep.encoders.layers import run
from jbrep.errors import InputError
from jbrep.methods import passes
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import get_method


def system(folder, actions=None, lengths=(60, 300, 1, 200, 15, 400, 350), extra=None):
    """A linear system of four features, moved by two actions; split and scaled."""
    generator = np.random.default_rng(0)
    dynamics = np.diag([0.98, 0.9, 0.7, 0.3]) + 0.05 * generator.normal(size=(4, 4))
    parts = [], [], [], []
    for length in lengths:
        state = generator.normal(size=4)
        rows, taken = np.empty((length, 4)), np.zeros((length, 2))
        for step in range(length):
            rows[step] = state
            drawn = generator.uniform(-1, 1, size=2)
            taken[step] = drawn if actions is None else actions(state)
            push = np.array([0.0, 0.5 * taken[step, 0], 0.0, 2 * taken[step, 1]])
            state = dynamics @ state + push + 0.1 * generator.normal(size=4)
        rows = rows if extra is None else np.column_stack((rows, extra(rows)))
        reward, ends = rows[:, 0] ** 2, np.zeros(length, bool)
        for part, values in zip(parts, (rows, taken, reward, ends), strict=True):
            part.append(values)
    return ScaledDataset(from_arrays(folder, *parts))


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    return system(tmp_path_factory.mktemp("closed") / "moved")


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return system(tmp_path_factory.mktemp("closed") / "still", actions=lambda state: 0)


def made(data, kind, **settings):
    method = get_method(kind).of({"latent": data.size, **settings})
    method.check_data(data)
    return method.make(data)


def episodes(data):
    """Scaled rows, actions and rewards of each training episode."""
    kept = set(data.train.tolist())
    for number in range(len(data.dataset.episodes["length"])):
        episode = data.dataset.episode(number)
        if episode.rows.start in kept:
            rows = data.scale(episode["observation"][:]).astype(float)
            yield rows, episode["action"][:].reshape(len(rows), -1), episode["reward"][:]


def same_space(some, others):
    """Whether the rows of both span the same space."""
    (a, _), (b, _) = np.linalg.qr(some.T.astype(float)), np.linalg.qr(others.T)
    return np.linalg.svd(a.T @ b)[1].min() > 1 - 1e-6


@pytest.mark.parametrize(("kind", "theirs"), [("slow", TICA), ("vamp", VAMP)])
def test_one_lag_is_deeptimes(still, kind, theirs):
    lag = 10
    ours = made(still, kind, lags=lag, latent=2)
    rows = [each for each, _, _ in episodes(still) if len(each) > lag]
    model = theirs(lagtime=lag, epsilon=1e-12, scaling=None).fit_from_timeseries(rows).fetch_model()
    spectrum = ours.metrics["spectrum"]
    theirs = sorted(model.singular_values, reverse=True)  # by magnitude, there
    np.testing.assert_allclose(spectrum, theirs, atol=1e-9)
    assert same_space(ours.encoder[0].weight, model.singular_vectors_left[:, :2].T)


def test_slow_features_of_several_lags_are_those_of_all_their_pairs(moved):
    first, second = [], []
    for rows, _, _ in episodes(moved):
        for start in range(len(rows) - 20):
            for lag in (2, 20):
                first += [rows[start], rows[start + lag]]
                second += [rows[start + lag], rows[start]]
    first, second = np.array(first), np.array(second)
    mean = first.mean(axis=0)
    covariance = (first - mean).T @ (first - mean)
    values, vectors = eigh((first - mean).T @ (second - mean), covariance)
    ours = made(moved, "slow", lags=(2, 20), latent=2)
    assert ours.metrics["spectrum"] == pytest.approx(values[::-1], abs=1e-9)
    assert same_space(ours.encoder[0].weight, vectors[:, ::-1][:, :2].T)
    code = run(ours.encoder, first.astype(np.float32))
    np.testing.assert_allclose(code.T @ code / len(code), np.eye(2) / 9, atol=1e-5)


def without(values, actions):
    """What a regression on the actions leaves of values."""
    wide = np.column_stack((actions, np.ones(len(actions))))
    return values - wide @ np.linalg.lstsq(wide, values, rcond=None)[0]


def test_vamp_is_the_canonical_correlation_that_the_actions_leave(moved):
    now, later, actions = [], [], []
    for rows, taken, _ in episodes(moved):
        for start in range(len(rows) - 5):
            now.append(rows[start])
            later.append(rows[start + 5])
            actions.append(taken[start : start + 5].ravel())
    sides = [np.linalg.qr(without(np.array(each), np.array(actions))) for each in (now, later)]
    left, correlations, _ = np.linalg.svd(sides[0][0].T @ sides[1][0])  # Bjorck and Golub 1973
    directions = np.linalg.solve(sides[0][1], left)
    ours = made(moved, "vamp", lags=5, latent=2)
    assert ours.metrics["spectrum"] == pytest.approx(correlations, abs=1e-6)
    assert same_space(ours.encoder[0].weight, directions[:, :2].T)
    code = run(ours.encoder, np.array(now, np.float32))
    np.testing.assert_allclose(code.std(axis=0), 1 / 3, atol=1e-5)


def test_the_linear_forward_code_is_reduced_rank_regression(data):
    horizons, regressors, targets = (1, 4), [], []
    weights = {"changes": 2, "reward": 0.5}
    turn = 2 * math.pi / data.scaler.half_width
    angles = np.array([feature.is_angle for feature in data.task.features])
    changes, values, reward = (weights.get(w, 1) for w in ("changes", "values", "reward"))
    scale = np.sqrt(np.tile(np.repeat([changes, values, 16 * reward], (16, 16, 1)), 2))
    for rows, taken, reward in episodes(data):
        for start in range(0, len(rows) - 4):
            regressors.append(np.concatenate((rows[start], taken[start : start + 4].ravel())))
            parts = []
            for k in horizons:
                change = rows[start + k] - rows[start]
                change[angles] -= np.round(change / turn)[angles] * turn[angles]
                parts += [change, rows[start + k], [reward[start : start + k].mean()]]
            targets.append(np.concatenate(parts))
    regressors, targets = np.array(regressors), np.array(targets)
    regressors -= regressors.mean(axis=0)
    standard = scale * (targets - targets.mean(axis=0)) / targets.std(axis=0)
    block = np.linalg.lstsq(regressors, standard, rcond=None)[0][:16]
    root = sqrtm(np.cov(regressors[:, :16].T, bias=True)).real
    left, singular, _ = np.linalg.svd(root @ block)
    ours = made(data, "linear-forward", horizons=horizons, latent=5, **weights)
    assert ours.metrics["spectrum"] == pytest.approx(singular, rel=1e-4, abs=1e-4)
    assert same_space(ours.encoder[0].weight, np.linalg.solve(root, left[:, :5]).T)


def test_the_file_has_the_spectrum(data, tmp_path):
    encoder = Fitter(data, tmp_path).fit("slow", latent=4, on="angles").encoder
    spectrum = encoder.header.metrics["spectrum"]
    assert encoder.name == "slow-angles-4"
    assert len(spectrum) == 18
    assert spectrum == sorted(spectrum, reverse=True)
    code = encoder.encode(data.dataset["observation"][data.train])
    np.testing.assert_allclose(code.std(axis=0), 1 / 3, rtol=0.05)


def test_blocks_give_every_window_once_and_only_so_many_where_rows_are_wide(moved, monkeypatch):
    monkeypatch.setattr(passes, "_BLOCK", 50)
    once = list(passes.blocks(moved, 20, width=10, work=1))
    expected = [rows[: len(rows) - 20] for rows, _, _ in episodes(moved)]
    given = np.concatenate([block.later(0) for block in once])
    np.testing.assert_array_equal(given, np.concatenate(expected))
    assert len(once) > 1
    monkeypatch.setattr(passes, "_MOST_WORK", len(given) // 4)
    some = [len(block) for block in passes.blocks(moved, 20, width=10, work=1)]
    assert 0 < sum(some) <= len(given) / 3


def test_features_that_depend_on_others_are_named(tmp_path):
    extra = system(tmp_path / "sum", extra=lambda rows: rows[:, :1] - 2 * rows[:, 2:3])
    names = extra.task.feature_names
    for kind in ("slow", "vamp", "linear-forward"):
        with pytest.raises(InputError, match=f"{names[0]}, {names[2]}, {names[4]}"):
            made(extra, kind, latent=2)
    assert made(extra.rescaled(without=names[4:]), "slow", latent=2)


def test_a_constant_feature_passes_around_or_is_refused(tmp_path):
    constant = system(tmp_path / "constant", extra=lambda rows: np.full((len(rows), 1), 0.7))
    *_, name = constant.task.feature_names
    ranges = [each.replace(low=-100.0, high=100.0) for each in constant.task.features]
    constant.task = constant.task.replace(features=tuple(ranges))
    for data in (constant, constant.rescaled("nominal"), constant.rescaled("standard")):
        for kind in ("slow", "vamp", "linear-forward"):
            with pytest.raises(InputError, match=f"{name} is constant in .*: let it pass around"):
                made(data, kind, latent=2)
    assert made(constant.rescaled("nominal", without=[name]), "slow", latent=2)


def test_actions_that_follow_from_the_state_leave_vamp_nothing(tmp_path):
    driven = system(tmp_path / "driven", actions=lambda state: 0.05 * state[:2])
    with pytest.raises(InputError, match="as of linear functions of each other or the actions"):
        made(driven, "vamp", latent=2)


@pytest.mark.parametrize("kind", ["linear-forward", "forward"])
def test_the_unit_of_the_reward_does_not_matter(kind, moved, tmp_path):
    source = moved.dataset
    ends = np.zeros(len(source), bool)
    ends[np.cumsum(source.episodes["length"]) - 1] = True
    how = {"latent": 2, "horizons": 5, "reward": 100}
    how |= {"epochs": 1} if kind == "forward" else {}
    found = []
    for unit in (1, 2.0**-40):
        columns = source["observation"][:], source["action"][:], source["reward"][:] * unit
        data = from_arrays(tmp_path / f"data-{unit}", *columns, ends)
        found.append(Fitter(data, tmp_path / f"{unit}").fit(kind, **how).encoder)
    one, tiny = (each.encoder[0].weight for each in found)
    assert one.tobytes() == tiny.tobytes()
