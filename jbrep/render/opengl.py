"""Whether there is anything to render with."""

import os
import sys

from jbrep.errors import InputError


def find_opengl() -> None:
    """Have MuJoCo look for OpenGL: for EGL where there is no display, unless MUJOCO_GL is set.

    It looks once, when it is first imported; so call this before that.

    Raises:
        InputError: there is none.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, RuntimeError) as error:
        raise no_opengl(error) from error


def no_opengl(error: Exception) -> InputError:
    """What to tell of MuJoCo's error."""
    reason = str(error).strip().partition("\n")[0]
    return InputError(
        f"rendering needs EGL, and MuJoCo finds none ({reason}): apt-get install libegl1 libgl1, "
        "and set MUJOCO_GL=egl, or glfw where there is a display"
    )
