"""Encoders of every kind from a data set: scaling, files, kills, mistakes."""

import re
import shutil
import signal
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import numpy as np
import pytest
from command import jbrep, start, wait_for
from small import write_again
from tensors import torch_threads
from threadpoolctl import threadpool_limits
from wide import wide

from jbrep import methods
from jbrep.dataset import Dataset, ScaledDataset, from_arrays
from jbrep.encoders import load
from jbrep.errors import InputError
from jbrep.evaluation.held_out import HeldOut
from jbrep.evaluation.reconstruction import reconstruction
from jbrep.methods.fit import Fitter
from jbrep.methods.linear import lost
from jbrep.methods.registry import METHODS, read_name
from jbrep.records.storage import exclusive
from jbrep.training.method import USUAL


def how(kind="dae", **changes):
    """Settings of a short training, as far as that method takes them."""
    short = {"latent": 4, "epochs": 3, "batch_size": 500, "features": "velocity_*"}
    short |= {"latent": 20} if kind in ("noise", "ofe") else {}
    short |= changes
    return {name: value for name, value in short.items() if METHODS[kind].takes(name)}


@pytest.mark.parametrize("kind", METHODS)
def test_every_kind_has_the_error_that_its_file_says(data, kind, tmp_path):
    fitted = Fitter(data, tmp_path).fit(kind, **how(kind))
    encoder = load(fitted.path)
    assert fitted.is_new
    assert fitted.path.name == f"{encoder.name}.safetensors"
    assert encoder.name.startswith(kind)
    rows = data.dataset["observation"][data.test]
    error = (encoder.decode(encoder.encode(rows)) - rows) / data.scaler.half_width
    if kind == "symmetry":  # which leaves out where the robot is
        assert encoder.header.metrics["held_out_mse"] < 1e-6
    else:
        expected = np.mean(error.astype(float) ** 2)
        assert encoder.header.metrics["held_out_mse"] == pytest.approx(expected, rel=1e-5)
    assert encoder.header.data["fingerprint"] == data.dataset.fingerprint
    assert encoder.header.data["train_rows"] == 4000
    own = set(METHODS[kind].__struct_fields__) - set(USUAL)
    unusual = {"codes"} if kind == "forward" else set()
    if kind in ("coordinates", "symmetry"):
        unusual = {"on", "scaling"}
    assert set(encoder.header.training) == own | unusual
    bytes_before = fitted.path.read_bytes()
    again = Fitter(data, tmp_path).fit(kind, **how(kind))
    assert not again.is_new
    assert fitted.path.read_bytes() == bytes_before


def test_every_method_is_registered():
    for each in iter_modules(methods.__path__, "jbrep.methods."):
        for method in vars(import_module(each.name)).values():
            if "name" in getattr(method, "__dict__", {}) and hasattr(method, "check_data"):
                assert METHODS[method.name] is method


def test_names_of_no_encoder_are_refused_and_a_name_of_ones_own_is_free(data, tmp_path):
    for name in ("wide-8", "dae", "dae-white-angles-8", "dae-authors-authors-8", "pca-deep-8", ""):
        with pytest.raises(InputError, match="unknown representation"):
            read_name(name)
    assert Fitter(data, tmp_path).fit("pca", latent=4, name="mine").encoder.name == "mine"
    with pytest.raises(InputError, match="the name of an encoder is"):
        Fitter(data, tmp_path).plan("pca", latent=4, name="../x")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.safetensors"]


def test_scaling_is_fitted_on_the_training_part_only(data, tmp_path):
    encoder = Fitter(data, tmp_path).fit("pca", **how("pca")).encoder
    rows = data.dataset["observation"][data.train]
    np.testing.assert_array_equal(encoder.scaler.low, rows.min(axis=0))
    np.testing.assert_array_equal(encoder.scaler.high, rows.max(axis=0))
    everything = data.dataset["observation"][:]
    assert (everything.max(axis=0) > encoder.scaler.high).any()


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """The file of a training that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole")
    return Fitter(data, folder).fit("dae", **how(epochs=6, batch_size=50)).path


def test_a_stopped_training_resumes_to_the_same_file(whole, collected, tmp_path):
    out, work = tmp_path / "stopped", tmp_path / "stopped" / "dae-4.training"
    training = ("--latent", 4, "--batch-size", 50, "--epochs", 6)
    command = ("train-dae", *training, "--data", collected, "--out", out)
    process = start(*command)
    assert wait_for((work / "checkpoint.safetensors").exists, process), process.communicate()[1]
    process.send_signal(signal.SIGTERM)
    told = process.communicate()[1]
    path = out / "dae-4.safetensors"
    assert process.returncode == 128 + signal.SIGTERM
    assert f"the same command resumes it; the best so far is in {out}" in told
    kept = load(path).header.metrics
    assert 1 <= kept["best_epoch"] <= kept["epochs"] < 6
    assert "dae-4: reconstructs held-out states" in jbrep(*command).output
    assert path.read_bytes() == whole.read_bytes()


def test_only_one_may_train_it(data, tmp_path):
    """Nor make it without training."""
    fitter = Fitter(data, tmp_path)
    for kind, given in (("dae", how()), ("pca", {"latent": 4})):
        path = tmp_path / f"{kind}-4.safetensors"
        alone = exclusive(path, beside=True)
        with alone, pytest.raises(InputError, match="is being written by process"):
            fitter.fit(kind, **given)
        assert fitter.fit(kind, **given).is_new


@pytest.mark.parametrize("kind", ["full", "pca", "dae"])
def test_constant_huge_and_tiny_features_give_finite_encoders(kind, tmp_path):
    data = wide([1, 300, 2, 120, 77])
    assert data.constant_features == ("obs_0",)
    encoder = Fitter(data, tmp_path).fit(kind, **how(kind, batch_size=100)).encoder
    rows = data.dataset["observation"][data.test]
    back = (encoder.decode(encoder(rows)) - rows) / data.scaler.half_width
    assert encoder.header.metrics["held_out_mse"] == pytest.approx(np.mean(back**2), rel=1e-3)
    assert np.abs(back).max() < 4
    if kind == "full":  # what is constant is scaled to 0
        assert not encoder(rows)[:, 0].any()
        assert not back[:, 0].any()
    assert encoder.task.name == "Humanoid-v5"


def test_observations_that_cannot_be_reduced_are_refused(tmp_path):
    single = Fitter(wide([20] * 5, features=1), tmp_path)
    with pytest.raises(InputError, match="Humanoid-v5 has 1 feature to encode, too few: use"):
        single.fit("dae", latent=1)
    assert single.fit("full", **how("full")).encoder.latent_size == 1
    data = wide([20] * 5)
    data.scaler.high[7] = 1e13
    with pytest.raises(
        InputError, match=r"the observations in .* are too large to be encoded: ten"
    ):
        Fitter(data, tmp_path).plan("dae", latent=4)


def test_on_symmetry_an_encoder_is_compared_over_what_symmetry_tells(data, tmp_path):
    """It leaves out where the robot is, which PCA is not to be blamed for losing."""
    fitter = Fitter(data, tmp_path)
    ours = fitter.fit("pca", latent=4, on="symmetry").encoder
    rows = data.dataset["observation"][data.test]
    errors = [
        np.square(lost(each, rows, data), dtype=float).mean(axis=0)
        for each in (ours, fitter.fit("pca", latent=4).encoder)
    ]
    told = [name not in ours.not_decoded for name in data.task.feature_names]
    assert 0 < sum(told) < len(told)
    expected = errors[0][told].sum() / errors[1][told].sum()
    judged = reconstruction(ours, HeldOut(data)).ratio_to_pca
    assert judged.value == pytest.approx(expected, rel=1e-4)
    assert errors[0].sum() / errors[1].sum() < 0.95 * expected


def test_where_pca_loses_nothing_there_is_no_ratio(tmp_path):
    random = np.random.default_rng(0)
    moving = random.normal(size=(400, 3))
    rows = np.column_stack((moving, moving[:, 0], moving.sum(axis=1)))
    ends = np.arange(400) % 50 == 49
    made = from_arrays(tmp_path / "d", rows, random.uniform(-1, 1, (400, 1)), moving[:, 0], ends)
    fitter = Fitter(made, tmp_path)
    untrained = fitter.fit("untrained", latent=4).encoder
    scaled = ScaledDataset(made)
    assert reconstruction(untrained, HeldOut(scaled)).ratio_to_pca is None


@pytest.mark.parametrize("kind", ["linear-forward", "vamp", "self-prediction"])
def test_an_encoder_has_the_same_bytes_whatever_the_number_of_threads(kind, data, tmp_path):
    made = []
    for threads in (1, 2):
        with torch_threads(threads), threadpool_limits(threads, "blas"):
            fresh = ScaledDataset(Dataset(data.dataset.folder))
            made.append(Fitter(fresh, tmp_path / str(threads)).fit(kind, **how(kind)).path)
    assert made[0].read_bytes() == made[1].read_bytes()


def test_the_command_takes_sizes_in_any_form(collected, tmp_path):
    out = ("--data", collected, "--out", tmp_path / "it")
    told = jbrep("train-dae", "--latent", "5,4", 3, "--epochs", 1, *out).stdout
    assert re.findall(r"^([\w-]+): reconstructs", told, re.MULTILINE) == ["dae-5", "dae-4", "dae-3"]


def test_a_last_batch_of_one_row_ends_no_training(tmp_path):
    sample = Path(__file__).parent.parent / "data/sample/face_direction"
    whole = ScaledDataset(Dataset(sample))  # 2,997 windows of training: 7 * 428 and one
    encoder = Fitter(whole, tmp_path).fit("ofe", latent=24, epochs=1, batch_size=428).encoder
    assert np.isfinite(encoder.encode(whole.dataset["observation"][:3])).all()


def test_other_settings_or_data_are_refused_and_nothing_is_lost(data, collected, tmp_path):
    fitter = Fitter(data, tmp_path)
    path = fitter.fit("dae", **how()).path
    before = path.read_bytes()
    with pytest.raises(
        InputError, match=r"made with other settings: noise 0\.1 \(now: 0\.2\); choose anoth"
    ):
        fitter.fit("dae", **how(noise=0.2))

    def shift(columns):
        return {**columns, "observation": columns["observation"] + 1}

    write_again(collected, tmp_path / "other", shift)
    other = ScaledDataset(Dataset(tmp_path / "other"))
    with pytest.raises(InputError, match=r"made with other settings: data [0-9a-f.]+ \(now"):
        Fitter(other, tmp_path).fit("dae", **how())
    assert path.read_bytes() == before
    shutil.copy(path, tmp_path / "ae-4.safetensors")
    with pytest.raises(InputError, match=r"made with other settings: kind dae \(now: ae\)"):
        fitter.fit("ae", **how("ae"))


def test_mistakes_are_named(data, tmp_path):
    fitter = Fitter(data, tmp_path)
    with pytest.raises(InputError, match="pca needs latent"):
        fitter.fit("pca")
    for kind, most in (("pca", 16), ("dae", 15), ("untrained", 15)):
        for latent in (0, -1, "many", 4097):
            with pytest.raises(InputError, match=f"latent is {latent!r}"):
                fitter.fit(kind, latent=latent)
        for latent in (most + 1, 20):
            with pytest.raises(InputError, match=f"latent size is {latent}: .* from 1 to {most}"):
                fitter.fit(kind, latent=latent)
    with pytest.raises(InputError, match="unknown kind 'vea': did you mean vae"):
        fitter.fit("vea")
    with pytest.raises(InputError, match="without noise is a plain autoencoder: use the kind ae"):
        fitter.fit("dae", **how(noise=0))
    (tmp_path / "file").write_text("")
    for kind in ("pca", "dae"):
        with pytest.raises(InputError, match="can't make the folder"):
            Fitter(data, tmp_path / "file").fit(kind, **how(kind))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
