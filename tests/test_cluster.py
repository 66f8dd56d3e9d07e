"""Studies on a Ray cluster: they outlive its nodes."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_study import TINY

from jbrep.studies import runner
from jbrep.studies.plan import Plan
from jbrep.studies.runner import work
from jbrep.studies.tables import read_tables, write_tables

ray = pytest.importorskip("ray")
STUDY = TINY.replace(seeds=(0,), steps=1000, evaluate_every=1000)


@pytest.mark.slow
def test_on_a_cluster_that_loses_a_node_a_study_comes_to_the_same_end(tmp_path):
    told = subprocess.run(
        [sys.executable, Path(__file__).parent / "helpers" / "cluster.py", tmp_path],
        capture_output=True,
        text=True,
        timeout=600,
        env={**os.environ, "HOME": str(tmp_path)},  # where Ray writes
    )
    assert told.returncode == 0, told.stderr[-3000:]
    plan = Plan(STUDY, tmp_path / "study-here")
    assert {work(plan.assigned(cell)).status for cell in plan.cells} == {"finished"}
    folders = (tmp_path / "study", plan.folder)
    for folder in folders:
        write_tables(folder)
    for ours, theirs in zip(*(read_tables(each).curves()[0] for each in folders), strict=True):
        assert (ours.label, ours.settings) == (theirs.label, theirs.settings)
        np.testing.assert_array_equal(ours.returns, theirs.returns)


def test_runs_whose_workers_are_killed_say_so(tmp_path, monkeypatch):
    """Without a cluster, whose five workers would take a minute."""

    def get(reference):
        raise ray.exceptions.WorkerCrashedError

    never = SimpleNamespace(remote=lambda *arguments: object())
    monkeypatch.setattr(runner, "on_cluster", lambda *arguments, **resources: never)
    monkeypatch.setattr(ray, "wait", lambda references: (references[:1], references[1:]))
    monkeypatch.setattr(ray, "get", get)
    plan = Plan(STUDY, tmp_path)
    ended = list(runner.on_ray(plan, plan.cells, 1))
    assert [each.name for each in ended] == [cell.name for cell in plan.cells]
    assert all("its worker was killed 5 times, perhaps" in each.message for each in ended)
