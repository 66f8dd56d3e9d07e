"""The scripts in examples/ walk through to their ends."""

import subprocess
import sys


def test_everything_that_one_can_bring(tmp_path):
    command = [sys.executable, "examples/own/own.py", tmp_path / "out"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "the module and the file from ONNX give equal tables" in done.stdout
    assert "the data set that has grown equals the one collected at once" in done.stdout
    for made in ("study/report.html", "mine.rrd", "pendulum-encoders/pca-2.safetensors"):
        assert (tmp_path / "out" / made).stat().st_size > 1000, made
    assert (tmp_path / "out/mixed-encoders/pca-2.safetensors").stat().st_size > 1000
