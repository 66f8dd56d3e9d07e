"""Rendering goes through EGL where there is one; MuJoCo and dm_control read this when imported."""

import os
import shutil
from ctypes.util import find_library
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from jbrep.opengl import prepare_opengl
from jbrep.records.commit import commits

commits()  # of the repository, before any test works in another folder
torch.set_num_threads(1)  # the workers share the cores
HEADLESS = find_library("EGL") is not None
if not HEADLESS:
    os.environ.setdefault("MUJOCO_GL", "disable")
prepare_opengl()
NO_SUITE = find_spec("shimmy") is None  # nor dm_control, as on Python 3.13
collect_ignore = ["test_domain.py"] if NO_SUITE else []
needs_egl = pytest.mark.skipif(not HEADLESS, reason="no EGL: install libegl1 and libgl1")


@pytest.fixture(scope="session", autouse=True)
def quick_figures():
    """Fonts as outlines: embedding them takes half of a report's time."""
    from jbrep.reporting.figures.panels import PAPER

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PAPER, "pdf.fonttype", 3)
        yield


@pytest.fixture(autouse=True)
def same_numbers(request):
    """A module's RANDOM gives a test the same numbers, whichever ran before it."""
    if hasattr(request.module, "RANDOM"):
        request.module.RANDOM = np.random.default_rng(0)


@pytest.fixture
def one_figure(monkeypatch):
    """Reports with their first figure alone: drawing all takes most of their time."""
    from jbrep.reporting import report

    draw = report.study_plots
    monkeypatch.setattr(report, "study_plots", lambda found: draw(found)[:1])


@pytest.fixture(scope="session", autouse=True)
def quick_evaluations():
    """Nonlinear regressions that learn little; test_prediction.py has them learn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jbrep.evaluation.regression._STEPS", 2)
        patch.setattr("jbrep.play.sources._GOOD_EPISODES", 2)
        yield


def collected_once(name, settings, tmp_path_factory):
    """Collected by the worker that needs it first; the other reads the same files."""
    from filelock import FileLock

    from jbrep.collecting import collect

    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = base / name / "face_direction"
    with FileLock(base / f"{name}.lock"):
        collect(settings, folder)  # leaves it alone where it is complete
    return folder


@pytest.fixture(scope="session")
def collected(tmp_path_factory):
    """Five shards of an episode each, with states: to be read, or copied before it is changed."""
    from small import settings

    return collected_once("collected", settings(), tmp_path_factory)


@pytest.fixture(scope="session")
def data(collected):
    """The same, scaled and split."""
    from jbrep.dataset import Dataset, ScaledDataset

    return ScaledDataset(Dataset(collected))


@pytest.fixture(scope="session")
def brief(tmp_path_factory):
    """The same with episodes of 100 steps."""
    import small

    return collected_once("brief", small.brief(), tmp_path_factory)


@pytest.fixture
def copied(collected, tmp_path):
    """A copy of it to spoil."""
    return shutil.copytree(collected, tmp_path / "copied")


@pytest.fixture
def diverging(brief, monkeypatch, tmp_path):
    """Of the episodes in `brief`, 1 goes non-finite in its 31st step and 2 in its first."""
    from jbrep.dataset import Dataset
    from jbrep.jitterbug.simulation import Simulation
    from jbrep.jitterbug.tasks import QUATERNION

    monkeypatch.chdir(tmp_path)  # MuJoCo logs there
    starts = Dataset(brief).episodes["initial_qpos"][:, QUATERNION]
    reset, step, remaining = Simulation.reset, Simulation.step, {}

    def begin(simulation, envs, *others):
        reset(simulation, envs, *others)
        for index in envs:
            remaining.pop((simulation, index), None)
            for episode, steps in ((1, 30), (2, 0)):
                if (simulation.readings.qpos[index, QUATERNION] == starts[episode]).all():
                    remaining[simulation, index] = steps

    def spoil(simulation, action):
        for at in [at for at in remaining if at[0] is simulation]:
            if remaining[at] == 0:
                simulation.readings.qvel[at[1], 0] = np.nan
            remaining[at] -= 1
        return step(simulation, action)

    monkeypatch.setattr(Simulation, "reset", begin)
    monkeypatch.setattr(Simulation, "step", spoil)


LONGEST = ("study", "readme", "docs", "verdicts", "golden", "examples", "rl", "fit", "rl_tasks")


def pytest_collection_modifyitems(items):
    """The longest files first, so that no worker is left with one while the other is done."""
    for item in items if NO_SUITE else ():
        if "dm_control/" in item.nodeid:
            item.add_marker(pytest.mark.skip(reason="needs jbrep[suite]"))
    items.sort(key=lambda item: item.module.__name__.removeprefix("test_") not in LONGEST)
