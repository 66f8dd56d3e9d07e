"""Rendering goes through EGL where there is one; MuJoCo and dm_control read this when imported."""

import os
from ctypes.util import find_library

import pytest
import torch

torch.set_num_threads(1)  # the workers share the cores
HEADLESS = find_library("EGL") is not None
os.environ.setdefault("MUJOCO_GL", "egl" if HEADLESS else "disable")
needs_egl = pytest.mark.skipif(not HEADLESS, reason="no EGL: install libegl1 and libgl1")
