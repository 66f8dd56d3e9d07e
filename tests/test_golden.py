"""The whole chain through the command line, against numbers that no rewrite may change.

Physics, hand-written policies and closed forms give their numbers almost exactly; what is learned,
and so depends on an order of sums, has tolerances.
"""

import csv
import json
from statistics import mean

import h5py
import numpy as np
import onnxruntime
import pytest
from command import jbrep

from jbrep.encoders import load

STUDY = """
tasks = ["face_direction"]
algorithms = ["sac"]
representations = ["full", "pca-8"]
seeds = 2
steps = 200
evaluate_every = 100
evaluation_episodes = 2
final_episodes = 2
episode_steps = 100
"""
LEARNING = ("--evaluate-every", 200, "--evaluation-episodes", 2, "--final-episodes", 2)


def done(*arguments):
    result = jbrep(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def returns(path, **where):
    """Returns in a table of a run or study, of the rows with these values."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return [float(row["return"]) for row in rows if all(row[k] == str(v) for k, v in where.items())]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Data, encoders, their evaluation, a run and a study."""
    out = tmp_path_factory.mktemp("golden")
    data = ("--data", out / "data")
    done("collect", "--task", "face_direction", "--steps", "4k", "--out", out / "data")
    done("train-dae", *data, "--latent", 8, "--epochs", 3, "--out", out / "encoders")
    done("train-encoder", "--kind", "pca", *data, "--latent", 4, "--out", out / "encoders")
    encoders = [out / "encoders" / f"{name}.safetensors" for name in ("dae-8", "pca-4")]
    done("evaluate", *data, "--encoder", *encoders, "--out", out / "evaluation")
    learn = ("rl", "--task", "face_direction", "--encoder", encoders[0], "--steps", 400)
    done(*learn, *LEARNING, "--out", out / "run")
    (out / "study.toml").write_text(STUDY)
    done("study", out / "study.toml", "--out", out / "study", "--workers", 1)
    return out


def test_states_of_the_robot(folder):
    with h5py.File(folder / "data" / "shard-00000.h5") as shard:
        observations, rewards = shard["observation"][:], shard["reward"][:]
    assert observations.shape == (4000, 16)
    assert rewards.mean() == pytest.approx(0.204608, rel=1e-4)
    assert observations.mean(axis=0)[[0, 2, 14]] == pytest.approx(
        [-0.0164101, 0.0351968, -0.0389079], rel=1e-3
    )
    assert observations.std(axis=0)[[7, 12, 15]] == pytest.approx(
        [0.103889, 3.04156, 1.82827], rel=1e-4
    )


def test_what_encoders_keep(folder):
    found = json.loads((folder / "evaluation" / "evaluation.json").read_text())["encoders"]
    full, dae, pca = found["full"], found["dae-8"], found["pca-4"]
    assert pca["reconstruction"]["mse"][0] == pytest.approx(0.111241, rel=1e-3)
    assert pca["reconstruction"]["ratio_to_pca"][0] == pytest.approx(1, rel=1e-6)
    assert dae["reconstruction"]["mse"][0] == pytest.approx(0.229057, rel=0.02)
    assert dae["reconstruction"]["ratio_to_pca"][0] == pytest.approx(3.526, rel=0.02)
    assert full["probes"]["heading"][0] == pytest.approx(0.503, abs=0.01)
    assert pca["probes"]["motor_phase"][0] == pytest.approx(0.3345, abs=0.01)
    assert dae["probes"]["uprightness"][0] == pytest.approx(0.290, abs=0.05)
    assert full["scores"]["next"][0] == pytest.approx(0.7123, abs=0.01)


def test_a_run(folder):
    table = folder / "run" / "evaluations.csv"
    assert len(returns(table)) == 6
    assert returns(table, step=0) == pytest.approx([211.5, 0.0], abs=2)  # the motor hardly turns
    assert json.loads((folder / "run" / "run.json").read_text())["latent_size"] == 8


def test_a_study_and_its_report(folder):
    study = folder / "study"
    assert len(returns(study / "returns.csv")) == 24
    references = {
        each: mean(returns(study / "references.csv", policy=each))
        for each in ("standing still", "constant drive", "random", "hand-written")
    }
    assert [*references.values()] == pytest.approx([10.5755, 36.7006, 5.7395, 52.45], rel=1e-3)
    (group,) = json.loads((study / "findings.json").read_text())["groups"]
    numbers = {each["representation"]: each["numbers"] for each in group["agents"]}
    for name in ("full", "pca-8"):
        of = numbers[name]
        last = mean(returns(study / "returns.csv", representation=name, step=200))
        assert of["final_return_mean"][0] == pytest.approx(last, rel=1e-6)
        assert of["score"][0] == pytest.approx((last - 36.7006) / (52.45 - 36.7006), rel=1e-3)


def test_an_encoder_elsewhere(folder):
    path = folder / "dae-8.onnx"
    done("encoder", "export", folder / "encoders" / "dae-8.safetensors", "--out", path)
    session = onnxruntime.InferenceSession(path)
    seen = np.linspace(-0.5, 0.5, 32, dtype=np.float32).reshape(2, 16)
    latent, decoded = session.run(["latent", "reconstruction"], {"observation": seen})
    encoder = load(folder / "encoders" / "dae-8.safetensors")
    assert (latent.shape, decoded.shape) == ((2, 8), (2, 16))
    np.testing.assert_allclose(latent, encoder.encode(seen), atol=1e-5)
    np.testing.assert_allclose(decoded, encoder.decode(latent), atol=1e-4)
