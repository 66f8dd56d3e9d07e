"""The whole system at toy size: from states to a report and a recording, undisturbed and killed."""

import csv
import json

import numpy as np
import pytest
from command import jbrep
from pipeline import ends, in_peace, killed, stages
from rerun.chunk import RrdReader

from jbrep.dataset import Dataset
from jbrep.encoders import load
from jbrep.rl.files import ENCODER, read_evaluations

SEEN = ("full", "dae-4")


@pytest.fixture(scope="module")
def peace(tmp_path_factory):
    """The folder of a pipeline that nothing disturbed, and what its commands said."""
    folder = tmp_path_factory.mktemp("peace")
    return folder, in_peace(folder)


def test_states_become_encoders_and_diagnostics(peace):
    folder, said = peace
    assert "4 episodes of face_direction, 2,000 rows" in said["collect"]
    assert "dae-4: reconstructs held-out states" in said["train-dae"]
    data, encoders = folder / "data", folder / "encoders"
    pca = ("--kind", "pca", "--data", data, "--latent", 8, 4, "--out", encoders)
    assert "pca-8: reconstructs held-out states" in jbrep("train-encoder", *pca).output
    paths = [encoders / f"{name}.safetensors" for name in ("dae-4", "pca-4")]
    again = jbrep(*stages(folder)["train-dae"]).output
    assert "dae-4.safetensors, already complete" in " ".join(again.split())
    assert "4 tanh" in jbrep("encoder", "info", paths[0]).output
    told = jbrep("encoder", "export", paths[0], "--out", folder / "it.onnx").output
    assert f"onnxruntime.InferenceSession('{folder / 'it.onnx'}')" in told
    told = jbrep("evaluate", "--encoder", *paths, "--data", data, "--out", folder / "judged")
    for label in ("full", "dae-4", "pca-4", "judged/evaluation.json"):
        assert label in told.output
    judged = json.loads((folder / "judged" / "evaluation.json").read_text())
    assert judged["data"]["fingerprint"] == Dataset(data).fingerprint
    for encoder in map(load, paths):
        found = judged["encoders"][encoder.name]
        assert found["sha256"] == encoder.fingerprint
        error = encoder.header.metrics["held_out_mse"]
        assert found["reconstruction"]["mse"][0] == pytest.approx(error, rel=1e-3)
        assert encoder.header.data["train_rows"] == 1500


def test_a_studys_tables_are_those_of_its_runs(peace):
    folder = peace[0] / "study"
    rows = list(csv.reader((folder / "returns.csv").read_text().splitlines()))[1:]
    (group,) = json.loads((folder / "findings.json").read_text())["groups"]
    assert [agents["representation"] for agents in group["agents"]] == list(SEEN)
    for label in group["agents"]:
        name = label["representation"]
        for seed, final in zip((0, 1), label["by_run"]["final_return"], strict=True):
            run = folder / "runs" / "face_direction" / "a2c" / name / f"seed-{seed}"
            ours = [
                (int(r[4]), int(r[5]), float(r[6])) for r in rows if r[2:4] == [name, f"{seed}"]
            ]
            assert ours == read_evaluations(run)
            assert [row[:2] for row in ours] == [(0, 0), *((80, i) for i in range(10))]
            assert final == pytest.approx(np.mean([row[2] for row in ours[1:]]))
            encoder = load(run / ENCODER)
            assert encoder.size == 16
            assert encoder.name == name
        mean = label["numbers"]["final_return_mean"][0]
        assert mean == pytest.approx(np.mean(label["by_run"]["final_return"]))
    assert len(rows) == 2 * 2 * (1 + 10)
    assert "| agents on | runs | final return | learned |" in (folder / "summary.md").read_text()
    made = folder / "encoders" / "face_direction" / "dae-4.safetensors"
    alone = peace[0] / "encoders" / "dae-4.safetensors"
    assert made.read_bytes() == alone.read_bytes()


def test_a_report_says_what_the_tables_say(peace):
    folder, said = peace[0] / "study", peace[1]["report"]
    found = json.loads((folder / "findings.json").read_text())
    page = (folder / "report.html").read_text()
    (group,) = found["groups"]
    assert found["verdicts"] == []  # nothing was claimed
    (comparison,) = group["comparisons"]
    full, dae = (np.array(label["by_run"]["final_return"]) for label in group["agents"])
    difference = comparison["numbers"]["final_return_difference"][0]
    assert (comparison["representation"], comparison["shared"]) == ("dae-4", 2)
    assert difference == pytest.approx((dae - full).mean())
    for run in found["runs"]:
        assert run["label"] in page
    assert (len(found["runs"]), found["missing"]) == (4, {})
    assert f"{folder / 'report.html'}\nBeside it: findings.json, summary.md" in said
    drawn = {path.stem for path in (folder / "figures").iterdir()}
    for name in drawn:
        for suffix in ("pdf", "png", "csv"):
            assert (folder / "figures" / f"{name}.{suffix}").stat().st_size > 0
    assert {"representations", "final_return", "every_run"} <= drawn


def test_a_recording_shows_the_agent_that_was_evaluated(peace, tmp_path):
    run = peace[0] / "study" / "runs" / "face_direction" / "a2c" / "dae-4" / "seed-1"
    assert "it.rrd" in jbrep("inspect", run, "--out", tmp_path / "it.rrd").output
    chunks = {chunk.entity_path: chunk for chunk in RrdReader(tmp_path / "it.rrd").stream()}
    (told,) = chunks["/provenance"].to_record_batch()["TextDocument:text"].to_pylist()[0]
    first_at_end = read_evaluations(run)[1]
    assert f"- return: {first_at_end.episode_return:.1f}" in told
    assert load(run / ENCODER).fingerprint in told
    assert "/world/ghost/jitterbug" in chunks


@pytest.mark.usefixtures("one_figure")
def test_killed_in_every_stage_it_comes_to_the_same_end(peace, tmp_path):
    """`python tests/helpers/pipeline.py 20` kills at twenty times as many points."""
    told = killed(tmp_path / "killed", 6, peace[0])  # the study's workers are at work then
    found, expected = ends(tmp_path / "killed"), ends(peace[0])
    assert found.keys() == expected.keys(), told
    for name, content in expected.items():
        assert found[name] == content, f"{name} differs; {told}"
