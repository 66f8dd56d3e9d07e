"""OpenGL to render with: on which platform, and what must be loaded before it."""

import importlib
import os
import sys
from contextlib import suppress

from jbrep.errors import InputError, first_line


def has_display() -> bool:
    """Whether windows can be opened; off Linux that is taken for granted."""
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def prepare_opengl() -> None:
    """Make the process ready to render; call it before anything is rendered.

    Without a display, MuJoCo is told to render through EGL, unless MUJOCO_GL is set. MuJoCo and
    dm_control read that when they are first imported, Gymnasium's renderer when it is made.

    Triton comes first: torch imports it with its first optimiser, and its LLVM crashes the process
    if Mesa's software renderer has loaded another LLVM before.
    """
    if not has_display():
        os.environ.setdefault("MUJOCO_GL", "egl")
    with suppress(ImportError):
        import triton  # noqa: F401


def find_opengl() -> None:
    """Have MuJoCo look for OpenGL, again where a user's module has imported it before."""
    chosen = sys.modules.get("mujoco.rendering.classic.gl_context")
    prepare_opengl()
    try:
        import mujoco  # noqa: F401

        if chosen:
            importlib.reload(chosen)
    except (AttributeError, ImportError, RuntimeError) as error:
        raise no_opengl(error) from error


def no_opengl(error: Exception) -> InputError:
    """What to say when MuJoCo can't render."""
    reason = first_line(error)
    return InputError(
        f"rendering needs EGL, and MuJoCo finds none ({reason}): apt-get install libegl1 libgl1, "
        "and set MUJOCO_GL=egl, or glfw where there is a display"
    )
