"""Worker processes: their jobs, their deaths, their end."""

import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import wait_for, wait_for_the_end_of, workers_of
from jobs import begun, die, fail, hang, kill_worker_of_first_run, never_stop, square
from test_study import TINY

from jbrep import machine
from jbrep.errors import InputError
from jbrep.pool import on_cluster
from jbrep.studies import runner
from jbrep.studies.plan import Plan
from jbrep.studies.runner import work
from jbrep.studies.tables import read_tables, write_tables

PARENT = """
import sys
from pathlib import Path
sys.path[:0] = {tests!r}
from jobs import begun, hang
if __name__ == "__main__":
    next(begun(hang, [Path({folder!r})] * 2, 2))
"""


def test_jobs_come_back_with_their_results():
    results = dict(begun(square, range(5), 2))
    assert {job: number for job, (number, _) in results.items()} == {n: n**2 for n in range(5)}
    workers = {process for _, process in results.values()}
    assert len(workers) <= 2  # used again
    assert not workers_of(os.getpid())


def test_a_worker_tells_a_notice_in_one_line():
    script = PARENT.replace("hang", "note").replace("2", "1").format(tests=sys.path, folder="")
    told = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert told.stderr == "Note: it is wet\n"


def test_the_job_of_a_dead_worker_is_tried_again(tmp_path):
    assert list(begun(die, [tmp_path], 1)) == [(tmp_path, "survived")]
    assert (tmp_path / "deaths").read_text() == "xxx"


def test_the_error_of_a_worker_is_raised():
    with pytest.raises(KeyError, match="what it lacks") as error:
        list(begun(fail, ["what it lacks"], 1))
    assert "in fail" in str(error.value.__cause__)  # its traceback


def interrupted(folder):
    """A job, and Ctrl-C when it is under way."""
    yield folder
    while not list(folder.iterdir()):
        time.sleep(0.01)
    raise KeyboardInterrupt


def test_jobs_are_asked_to_stop_and_waited_for(tmp_path):
    said = []
    with pytest.raises(KeyboardInterrupt):
        list(begun(hang, interrupted(tmp_path), 2, 60, lambda: said.append("stopping")))
    assert (tmp_path / "stopped").exists()
    assert said == ["stopping"]
    assert not workers_of(os.getpid())


def test_an_interrupted_stop_ends_jobs_at_once(tmp_path):
    def interrupt():
        raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(begun(never_stop, interrupted(tmp_path), 2, 600, interrupt))
    assert time.monotonic() - started < 60
    assert not workers_of(os.getpid())


@pytest.mark.parametrize("delay", [0, 0.6])
def test_no_worker_outlives_its_parent(delay, tmp_path):
    """Killed while its workers start, or when they are at work."""
    script = PARENT.format(tests=sys.path, folder=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", script])
    assert wait_for(lambda: workers_of(process.pid), process)
    time.sleep(delay)
    workers = workers_of(process.pid)
    process.kill()
    process.wait()
    assert workers
    wait_for_the_end_of(workers, seconds=10)
    assert not (tmp_path / "stopped").exists()


def test_a_run_that_kills_its_workers_crashes_alone(monkeypatch):
    """Each run has five workers to lose."""
    monkeypatch.setattr(runner, "work", kill_worker_of_first_run)
    plan = SimpleNamespace(assigned=lambda name: SimpleNamespace(name=name), known=None)
    *others, crashed = runner.on_this_machine(plan, ("first", "second", "third"), 2)
    assert sorted(others) == ["outcome of second", "outcome of third"]
    assert (crashed.name, crashed.status) == ("first", "crashed")
    assert crashed.message.startswith("its worker was killed 5 times, perhaps because memory ran")


@pytest.mark.parametrize("address", ["127.0.0.1:9", "ray://127.0.0.1:9", "no such; thing"])
@pytest.mark.usefixtures("ray")
def test_a_cluster_that_is_not_there_is_told_at_once(address, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(InputError, match=f"^no Ray cluster at RAY_ADDRESS={address}: "):
        on_cluster(print, 1, 0)


@pytest.mark.parametrize("limit", machine._LIMITS)
def test_a_container_has_less_memory_than_its_machine(limit, tmp_path, monkeypatch):
    (tmp_path / "memory").mkdir()
    (tmp_path / limit).write_text(f"{256 << 20}\n")
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    assert machine.memory() == 256 << 20


STUDY = TINY.replace(seeds=(0,), steps=1000, evaluate_every=1000)


@pytest.fixture
def ray():
    return pytest.importorskip("ray")


@pytest.mark.slow
@pytest.mark.usefixtures("ray")
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


def test_runs_whose_workers_are_killed_say_so(ray, tmp_path, monkeypatch):
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
