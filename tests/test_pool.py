"""Worker processes: their jobs, their deaths, their end."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from command import wait_for, wait_for_the_end_of, workers_of

from jbrep.errors import InputError
from jbrep.pool import Pool, on_cluster, stop_requested

PARENT = """
import sys
sys.path[:0] = {tests!r}
from test_pool import Pool, hang
if __name__ == "__main__":
    with Pool(hang, 2, lambda: None) as pool:
        pool.submit("a", {folder!r})
        pool.submit("b", {folder!r})
        pool.result()
"""


def square(number):
    return number**2, os.getpid()


def die(folder):
    """Take the worker along at the first two times."""
    with (folder / "deaths").open("a") as file:
        file.write("x")
    if len((folder / "deaths").read_text()) <= 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


def kill_worker_of_first_run(name):
    """Used instead of `work`."""
    if name == "first":
        os.kill(os.getpid(), signal.SIGKILL)
    return f"outcome of {name}"


def hang(folder):
    (Path(folder) / str(os.getpid())).touch()
    while not stop_requested():
        time.sleep(0.01)
    (Path(folder) / "stopped").touch()


def never_stop(folder):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(600)


def not_called():
    raise AssertionError


def test_jobs_come_back_under_their_names():
    with Pool(square, 2, not_called) as pool:
        pool.submit("three", 3)
        assert not pool.is_full
        pool.submit("four", 4)
        assert pool.is_full
        results = dict(pool.result() for _ in range(2))
        assert {name: value for name, (value, _) in results.items()} == {"three": 9, "four": 16}
        pool.submit("five", 5)
        job, (value, process) = pool.result()
        assert (job, value) == ("five", 25)
        assert process in [worker for _, worker in results.values()]  # used again
        assert pool.is_idle
    wait_for_the_end_of([worker for _, worker in results.values()], seconds=60)


def test_the_job_of_a_dead_worker_is_named(tmp_path):
    with Pool(die, 1, not_called) as pool:
        for expected in (None, None, "survived"):
            pool.submit("job", tmp_path)
            assert pool.result() == ("job", expected)


def test_jobs_are_asked_to_stop_and_waited_for(tmp_path):
    said = []
    with Pool(hang, 1, lambda: said.append("stopping")) as pool:
        pool.submit("job", tmp_path)
        while not list(tmp_path.iterdir()):
            time.sleep(0.01)
    assert (tmp_path / "stopped").exists()
    assert said == ["stopping"]
    assert not workers_of(os.getpid())


def test_an_interrupted_stop_ends_jobs_at_once(tmp_path):
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Pool(never_stop, 1, interrupt) as pool:  # noqa: PT012
        pool.submit("job", tmp_path)
        while not list(tmp_path.iterdir()):
            time.sleep(0.01)
        started = time.monotonic()
    assert time.monotonic() - started < 60
    assert not workers_of(os.getpid())


@pytest.mark.parametrize("delay", [0.05, 0.2, 0.6])
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
    from jbrep.study import runner

    monkeypatch.setattr(runner, "work", kill_worker_of_first_run)
    monkeypatch.setattr(runner, "_job", lambda plan, cell: (cell.name,))
    names = ("first", "second", "third", "fourth")
    cells = [SimpleNamespace(name=name) for name in names]
    *others, crashed = runner.on_this_machine(None, cells, 2)
    assert sorted(others) == ["outcome of fourth", "outcome of second", "outcome of third"]
    assert (crashed.name, crashed.status) == ("first", "crashed")
    assert crashed.message.startswith("its worker was killed 5 times, perhaps because memory ran")


@pytest.mark.parametrize("address", ["127.0.0.1:9", "ray://127.0.0.1:9", "no such; thing"])
def test_a_cluster_that_is_not_there_is_told_at_once(address, monkeypatch):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(InputError, match=f"^no Ray cluster at RAY_ADDRESS={address}: "):
        on_cluster(print, 1)
