"""Diagnostics: against closed forms, other libraries, and sums by hand."""

from pathlib import Path

import numpy as np
import pytest
from command import jbrep
from sklearn.metrics import r2_score
from test_controls import projection
from wide import make_feature, make_task, wide

from jbrep.dataset import ScaledDataset, Scaler
from jbrep.encoders import Encoder, Layer, find, save
from jbrep.encoders.header import EncoderHeader
from jbrep.encoders.shipped import unlearned
from jbrep.errors import InputError
from jbrep.evaluation.diagnosis import diagnose, seen, write
from jbrep.evaluation.evaluation import EVALUATION, Evaluation
from jbrep.evaluation.held_out import MAX_NUMBERS, HeldOut, sample_rows
from jbrep.evaluation.readout import every, latent_units
from jbrep.evaluation.reconstruction import reconstruction
from jbrep.methods.linear import principal_code
from jbrep.records.document import read_document
from jbrep.reporting.evaluation import evaluation_text
from jbrep.stats.bootstrap import bootstrap


@pytest.fixture(scope="module")
def held_out(data):
    """Three of the five episodes, so that there is something to resample."""
    wide = ScaledDataset(data.dataset)
    wide.train, wide.test = data.dataset.split(test=0.6)
    wide.scaler = data.dataset.fit_scaler(wide.train)
    return HeldOut(wide)


def make(scaled, parts, **changes):
    task = changes.pop("task", scaled.task)
    header = EncoderHeader(kind="test", name="it-4", environment=task, **changes)
    return Encoder(header, scaled.scaler, *parts)


@pytest.fixture(scope="module")
def coder(held_out):
    """A random projection to 4 numbers."""
    return make(held_out.data, projection(held_out.data, 4, seed=0))


@pytest.fixture(scope="module")
def everything(held_out):
    """The scaled observation itself."""
    return make(held_out.data, ((), ()))


def test_intervals_cover_the_truth_as_often_as_they_say():
    random = np.random.default_rng(0)
    covered = 0
    for _ in range(300):
        episodes = random.normal(3, 2, size=(60, 1))
        result = bootstrap(lambda s, n: (s / n)[..., 0], episodes, np.ones((60, 1)))
        assert result.value == pytest.approx(episodes.mean())
        covered += result.low <= 3 <= result.high
    assert 0.9 <= covered / 300 <= 0.98


def test_held_out_rows_know_their_episodes(held_out):
    episode = held_out.data.dataset["episode"][held_out.data.test]
    assert held_out.numbers.tolist() == np.unique(episode).tolist()
    (counts,) = held_out.sums(held_out.data.test, np.ones((len(episode), 1)))
    assert counts.ravel().tolist() == [1000, 1000, 1000]


def test_of_very_many_episodes_groups_are_resampled():
    lengths = np.random.default_rng(0).integers(1, 4, 12_000)
    it = HeldOut(wide(lengths.tolist(), features=4))
    episode = np.repeat(np.arange(12_000), lengths)[it.data.test]
    begins = np.diff(episode, prepend=-1) != 0
    (count,) = it.sums(it.data.test, begins[:, None].astype(float))
    assert len(it.numbers) == 2400
    assert len(count) == 1000
    assert {*count.ravel()} == {2, 3}  # whole episodes


def test_sums_of_parts_are_those_of_the_whole(held_out):
    rows = held_out.data.test
    values = held_out.data.load(rows)
    parts = ((values[i : i + 700], values[i : i + 700, :3]) for i in range(0, len(rows), 700))
    whole = held_out.sums(rows, values, values[:, :3])
    for ours, theirs in zip(held_out.sums_of_parts(rows, parts), whole, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12)


def test_errors_are_those_of_encode_and_decode(held_out, coder):
    result = reconstruction(coder, held_out)
    rows = held_out.data.dataset["observation"][held_out.data.test]
    lost = coder.decode(coder.encode(rows)).astype(float) - rows
    scaled = lost / held_out.data.scaler.half_width
    assert result.mse[0] == pytest.approx(np.mean(scaled**2), rel=1e-5)
    assert result.mse[1] < result.mse[0] < result.mse[2]
    for i, feature in enumerate(result.features):
        assert feature.name == held_out.data.task.feature_names[i]
        assert feature.mse[0] == pytest.approx(np.mean(scaled[:, i] ** 2), rel=1e-4)
        rmse = np.sqrt(np.mean(lost[:, i] ** 2))
        assert feature.rmse_physical[0] == pytest.approx(rmse, rel=1e-4)
        r2 = r2_score(rows[:, i].astype(float), rows[:, i] + lost[:, i])
        assert feature.r2[0] == pytest.approx(r2, rel=1e-3, abs=1e-4)


def test_pca_is_its_own_reference_and_the_full_observation_loses_nothing(
    held_out, coder, everything
):
    same = reconstruction(make(held_out.data, principal_code(held_out.data, 4)), held_out)
    np.testing.assert_allclose(same.ratio_to_pca, 1, rtol=1e-4)
    assert same.mse == pytest.approx(same.pca_mse, rel=1e-4)
    assert reconstruction(coder, held_out).ratio_to_pca[0] > 1
    nothing = reconstruction(everything, held_out)
    assert nothing.mse[0] < 1e-10
    assert nothing.ratio_to_pca is None


def test_errors_are_scaled_by_the_data_not_by_the_encoder(held_out, coder):
    wider = Scaler(coder.scaler.low * 2 - 1, coder.scaler.high * 2 + 1)
    stretched = Encoder(coder.header, wider, (), ())
    moved = Layer(np.eye(16, dtype=np.float32), np.full(16, 0.01, np.float32), "linear")
    shifted = Encoder(coder.header, wider, (), (moved,))
    assert reconstruction(stretched, held_out).mse[0] < 1e-10
    expected = np.mean((0.01 * wider.half_width / held_out.data.scaler.half_width) ** 2)
    assert reconstruction(shifted, held_out).mse[0] == pytest.approx(expected, rel=1e-3)


def test_dead_units_are_found(held_out):
    weight = np.zeros((4, 16), np.float32)
    weight[0, 14], weight[1, 13], weight[3, 13] = 1, 50, 0.001
    parts = (
        (Layer(weight, np.zeros(4, np.float32), "tanh"),),
        (Layer(weight.T, np.zeros(16, np.float32), "linear"),),
    )
    result = latent_units(make(held_out.data, parts), held_out)
    assert result.dead == (2, 3)
    assert 1 < result.participation_ratio < 2


def test_probes_are_of_every_feature():
    features = [
        make_feature("height", "m", -1, 1, bounded=True),
        make_feature("yaw", "rad", -np.pi, np.pi, bounded=True, kind="angle"),
        make_feature("turns", "rad", -np.pi, np.pi, kind="angle"),
        make_feature("knee", "rad", -0.5, 0.5, bounded=True),
        make_feature("unknown"),
    ]
    robot = make_task(features, name="my_package/Robot-v0")
    rows = np.random.default_rng(0).uniform(-3, 3, (20, 5))
    result = every(robot, rows)
    assert list(result) == ["height", "yaw", "turns", "knee", "unknown"]
    np.testing.assert_array_equal(result["turns"], rows[:, 2:3])
    np.testing.assert_allclose(result["yaw"], np.stack((np.cos(rows[:, 1]), np.sin(rows[:, 1])), 1))


def test_a_wide_robot_can_be_judged(tmp_path):
    rows = np.arange(10**6)
    assert len(sample_rows(rows, 10**5, 348)) == MAX_NUMBERS // 348
    data = wide([1, 300, 2, 1, 250, 99, 1, 180], features=70)
    evaluation = write({"r-20": make(data, projection(data, 20, 0))}, data, tmp_path)
    for result in evaluation.encoders.values():
        assert set(result.nonlinear_probes["obs_0"]) == {None}  # it is constant
    shown = evaluation_text(evaluation, 100, everything=True)
    assert max(map(len, shown.splitlines())) <= 100


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_labels_and_numbers_that_cannot_be_judged(data):
    with pytest.raises(InputError, match="the label full is reserved for the observation itself"):
        diagnose({"full": make(data, ((), ()))}, data)
    huge = Layer(np.full((16, 16), 1e11, np.float32), np.zeros(16, np.float32), "linear")
    with pytest.raises(InputError, match="it gives numbers that are not finite"):
        diagnose({"it": make(data, ((), (huge,) * 4))}, data)


def test_an_evaluation_is_one_file_and_repeats(data, tmp_path):
    parts = {"pca-4": principal_code(data, 4), "r-4": projection(data, 4, 0)}
    encoders = {name: make(data, each) for name, each in parts.items()}
    one, path = write(encoders, data, tmp_path / "it"), tmp_path / "it" / EVALUATION
    text, there = path.read_text(), read_document(path, Evaluation)
    assert list(there.encoders) == ["full", "pca-4", "r-4"]
    assert there.text() == text == one.text()
    assert there.hashes == {name: each.fingerprint for name, each in encoders.items()}
    assert write(encoders, data, tmp_path / "it") == one
    with pytest.raises(InputError, match="is not an evaluation of these encoders"):
        write({"r-4": encoders["r-4"]}, data, tmp_path / "it")
    assert path.read_text() == text
    assert "nan" not in evaluation_text(there)


def test_the_command_says_which_encoders_were_taken(collected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(find("pca-4", "face_direction").with_header(name="dae-4"), Path("dae-4"))
    chosen = ("--encoder", "dae-4", "./dae-4")
    assert jbrep("evaluate", *chosen, "--data", collected, "--out", "judged").exit_code == 0
    evaluation = read_document(Path("judged", EVALUATION), Evaluation)
    assert list(evaluation.encoders) == ["full", "dae-4, shipped", "./dae-4"]


def test_whether_an_encoder_may_have_seen_the_episodes(data):
    fingerprint = data.dataset.fingerprint
    for source, seed, policy, expected in (
        (fingerprint, 3, {}, "no test row"),
        ("other", 3, {}, "maybe"),
        ("other", 4, {}, "none"),
        ("other", 4, {"policy": {"kind": "imported"}}, "maybe"),
        ("other", 4, {"policy": 3}, "none"),  # as a stranger may write it
    ):
        known = {"fingerprint": source, "seed": seed, **policy}
        assert seen(make(data, principal_code(data, 2), data=known), data) == expected


def test_what_symmetry_leaves_out_is_no_success(data):
    """A robot that is decoded at the origin isn't one whose position was kept."""
    errors = reconstruction(unlearned(data.task, "symmetry"), HeldOut(data))
    r2 = {each.name: each.r2.value for each in errors.features}
    assert {r2[name] for name in ("position_x", "position_y", "orientation_z")} == {None}
    assert r2["motor_angle"] > 0.999
