"""The whole chain through the command line, against numbers that no rewrite may change.

Physics, scripted policies and closed forms give their numbers almost exactly; what is learned,
and so depends on an order of sums, has tolerances. What one stage says is what the next one reads.
"""

import csv
import json
from statistics import mean

import h5py
import numpy as np
import onnxruntime
import pytest
from command import in_this_process, jbrep
from rerun.chunk import RrdReader

from jbrep.dataset import Dataset
from jbrep.encoders import load
from jbrep.reporting import report
from jbrep.rl.files import ENCODER, read_evaluations
from jbrep.studies.runner import BACKENDS

STUDY = """
tasks = ["face_direction"]
representations = ["full", "pca-8"]
seeds = 2
steps = 200
evaluate_every = 100
evaluation_episodes = 2
final_episodes = 2
episode_steps = 100

[algorithms.small-sac]
base = "sac-paper"
net_arch = [16]
"""
LEARNING = ("--steps", 200, "--episode-steps", 100, "--set", "net_arch=[16]")
LEARNING += ("--evaluate-every", 100, "--evaluation-episodes", 2, "--final-episodes", 2)


def done(*arguments):
    result = jbrep(*arguments)
    assert result.exit_code == 0, result.output
    return " ".join(result.stdout.split())


def returns(path, **where):
    """Returns in a table of a run or study, of the rows with these values."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return [float(row["return"]) for row in rows if all(row[k] == str(v) for k, v in where.items())]


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Data, encoders, their evaluation, a run and a study: the folder, and what was said."""
    out, said = tmp_path_factory.mktemp("golden"), {}
    data, task = ("--data", out / "data"), ("--task", "face_direction")
    (out / "study.toml").write_text(STUDY)
    encoders = [out / "encoders" / f"{name}.safetensors" for name in ("dae-8", "pca-4")]
    train = ("train-dae", *data, "--latent", 8, "--epochs", 3, "--out", out / "encoders")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(BACKENDS, "local", in_this_process)
        draw = report.study_plots
        patch.setattr(report, "study_plots", lambda found: draw(found)[:1])
        said["collect"] = done("collect", *task, "--steps", "4k", "--out", out / "data")
        said["train"], said["again"] = done(*train), done(*train)
        done("train-encoder", "--kind", "pca", *data, "--latent", 4, "--out", out / "encoders")
        done("evaluate", *data, "--encoder", *encoders, "--out", out / "evaluation")
        done("rl", *task, "--encoder", encoders[0], *LEARNING, "--out", out / "run")
        said["study"] = done("study", out / "study.toml", "--out", out / "study", "--workers", 1)
    return out, said


@pytest.fixture
def folder(chain):
    return chain[0]


def test_commands_say_what_they_made(chain):
    folder, said = chain
    assert "4 episodes of face_direction, 4,000 rows" in said["collect"]
    assert "dae-8: reconstructs held-out states" in said["train"]
    assert "dae-8.safetensors, already complete" in said["again"]
    assert f"{folder / 'study/report.html'} Beside it: findings.json, summary.md" in said["study"]


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
    judged = json.loads((folder / "evaluation" / "evaluation.json").read_text())
    assert judged["data"]["fingerprint"] == Dataset(folder / "data").fingerprint
    found = judged["encoders"]
    for name in ("dae-8", "pca-4"):
        encoder = load(folder / "encoders" / f"{name}.safetensors")
        assert found[name]["sha256"] == encoder.fingerprint
        error = encoder.header.metrics["held_out_mse"]
        assert found[name]["reconstruction"]["mse"][0] == pytest.approx(error, rel=1e-3)
    dae, pca = found["dae-8"], found["pca-4"]
    assert pca["reconstruction"]["mse"][0] == pytest.approx(0.111241, rel=1e-3)
    assert pca["reconstruction"]["ratio_to_pca"][0] == pytest.approx(1, rel=1e-6)
    assert dae["reconstruction"]["mse"][0] == pytest.approx(0.229057, rel=0.02)
    assert dae["reconstruction"]["ratio_to_pca"][0] == pytest.approx(3.526, rel=0.02)


def test_a_run(folder):
    table = folder / "run" / "evaluations.csv"
    assert len(returns(table)) == 6
    assert returns(table, step=0) == pytest.approx([22.0, 0.0], abs=0.3)  # the motor hardly turns
    assert json.loads((folder / "run" / "run.json").read_text())["latent_size"] == 8


def test_a_study_and_its_report(folder):
    study = folder / "study"
    assert len(returns(study / "returns.csv")) == 24
    references = {
        each: mean(returns(study / "references.csv", policy=each))
        for each in ("standing still", "constant action", "random", "scripted")
    }
    assert [*references.values()] == pytest.approx([10.5755, 36.7006, 5.7395, 52.45], rel=1e-3)
    found = json.loads((study / "findings.json").read_text())
    (group,) = found["groups"]
    full, pca = group["agents"]
    for each, name in ((full, "full"), (pca, "pca-8")):
        finals = []
        for seed in (0, 1):
            run = study / f"runs/face_direction/small-sac/{name}/seed-{seed}"
            played = read_evaluations(run)
            ours = returns(study / "returns.csv", representation=name, seed=seed)
            assert ours == [row.episode_return for row in played]
            assert [row[:2] for row in played] == [(n, i) for n in (0, 100, 200) for i in (0, 1)]
            finals.append(mean(ours[-2:]))
            assert load(run / ENCODER).name == name
        assert each["by_run"]["final_return"] == pytest.approx(finals)
        assert each["numbers"]["final_return_mean"][0] == pytest.approx(mean(finals), rel=1e-6)
        score = (mean(finals) - 36.7006) / (52.45 - 36.7006)
        assert each["numbers"]["score"][0] == pytest.approx(score, rel=1e-3)
    (comparison,) = group["comparisons"]
    means = [each["numbers"]["final_return_mean"][0] for each in (full, pca)]
    difference = comparison["numbers"]["final_return_difference"][0]
    assert (comparison["representation"], comparison["shared"]) == ("pca-8", 2)
    assert difference == pytest.approx(means[1] - means[0])
    page = (study / "report.html").read_text()
    assert all(run["label"] in page for run in found["runs"])
    assert (len(found["runs"]), found["missing"], found["verdicts"]) == (4, {}, [])
    assert "| agents on | final return | above baselines |" in (study / "summary.md").read_text()
    assert {path.suffix for path in (study / "figures").iterdir()} == {".csv", ".pdf", ".png"}


def test_a_recording_shows_the_agent_that_was_evaluated(folder):
    run, out = folder / "study/runs/face_direction/small-sac/pca-8/seed-1", folder / "it.rrd"
    assert "it.rrd" in done("inspect", run, "--out", out)
    chunks = {chunk.entity_path: chunk for chunk in RrdReader(out).stream()}
    (told,) = chunks["/provenance"].to_record_batch()["TextDocument:text"].to_pylist()[0]
    at_end = [row.episode_return for row in read_evaluations(run) if row.step == 200]
    assert f"- return: {at_end[0]:.1f}" in told
    assert load(run / ENCODER).fingerprint in told
    assert "/world/ghost/jitterbug" in chunks


def test_an_encoder_elsewhere(folder):
    path = folder / "dae-8.onnx"
    said = done("encoder", "export", folder / "encoders" / "dae-8.safetensors", "--out", path)
    assert f"onnxruntime.InferenceSession('{path}')" in said
    session = onnxruntime.InferenceSession(path)
    seen = np.linspace(-0.5, 0.5, 32, dtype=np.float32).reshape(2, 16)
    latent, decoded = session.run(["latent", "reconstruction"], {"observation": seen})
    encoder = load(folder / "encoders" / "dae-8.safetensors")
    assert (latent.shape, decoded.shape) == ((2, 8), (2, 16))
    np.testing.assert_allclose(latent, encoder.encode(seen), atol=1e-5)
    np.testing.assert_allclose(decoded, encoder.decode(latent), atol=1e-4)
