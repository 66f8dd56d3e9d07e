"""Rendering goes through EGL where there is one; MuJoCo and dm_control read this when imported."""

import os
import shutil
from ctypes.util import find_library

import pytest
import torch

from jbrep.opengl import prepare_opengl

torch.set_num_threads(1)  # the workers share the cores
HEADLESS = find_library("EGL") is not None
if not HEADLESS:
    os.environ.setdefault("MUJOCO_GL", "disable")
prepare_opengl()
needs_egl = pytest.mark.skipif(not HEADLESS, reason="no EGL: install libegl1 and libgl1")


@pytest.fixture(scope="session")
def collected(tmp_path_factory):
    """Five shards of an episode each, with states: to be read, or copied before it is changed."""
    from small import settings

    from jbrep.collect import collect

    folder = tmp_path_factory.mktemp("collected") / "face_direction"
    collect(settings(), folder)
    return folder


@pytest.fixture
def copied(collected, tmp_path):
    """A copy of it to spoil."""
    return shutil.copytree(collected, tmp_path / "copied")


LONGEST = ("test_whole", "test_study", "test_rl", "test_cli", "test_report")


def pytest_collection_modifyitems(items):
    """The longest first, so that no worker is left with one while the others are done."""
    items.sort(key=lambda item: item.module.__name__ not in LONGEST)
