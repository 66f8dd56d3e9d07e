"""The scripts in examples/ walk through to their ends."""

import os
import runpy
import sys
from pathlib import Path

import pytest
from command import in_this_process

from jbrep.study.runner import BACKENDS

OWN = Path("examples/own/own.py").resolve()


@pytest.mark.usefixtures("one_figure")
@pytest.mark.filterwarnings("ignore")  # a user sees them once, if at all
def test_everything_that_one_can_bring(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    monkeypatch.setattr("jbrep.envs.names._imported", [])  # it imports net
    monkeypatch.setattr(sys, "argv", [str(OWN), str(tmp_path / "out")])
    monkeypatch.syspath_prepend(OWN.parent)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    monkeypatch.setenv("MINARI_DATASETS_PATH", "")
    runpy.run_path(str(OWN), run_name="__main__")
    told = capfd.readouterr().out
    assert "the module and the file from ONNX give equal tables" in told
    assert "the data set that has grown equals the one collected at once" in told
    for made in ("study/report.html", "mine.rrd", "pendulum-encoders/pca-2.safetensors"):
        assert (tmp_path / "out" / made).stat().st_size > 1000, made
    assert (tmp_path / "out/mixed-encoders/pca-2.safetensors").stat().st_size > 1000
