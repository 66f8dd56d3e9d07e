"""What jbrep can use of this machine, and what is missing."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

from jbrep.machine import cores, memory

_DISTRIBUTIONS = {  # that are called otherwise than the module they bring
    "PIL": "pillow",
    "rerun": "rerun-sdk",
    "sklearn": "scikit-learn",
}
_RENDER = """
from jbrep.opengl import find_opengl
find_opengl()
import mujoco
from OpenGL import GL
with mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8):
    print(GL.glGetString(GL.GL_RENDERER).decode())
"""


class Line(NamedTuple):
    """A line of the result."""

    what: str
    said: str
    is_wrong: bool = False  # a fault, not just a missing extra


def examine() -> Iterator[Line]:
    """Describe the machine, then the packages of each extra."""
    where = f"Python {platform.python_version()}, {platform.platform()}"
    yield Line("jbrep", f"{version('jbrep')} on {where}")
    yield Line("cores", f"{cores()}: collect steps robots on all, a study has a run on each")
    if hasattr(os, "sysconf"):  # not on Windows
        yield Line("memory", f"{memory() / 2**30:.0f} GiB")
    with suppress(OSError):  # where this folder was deleted
        free = shutil.disk_usage(Path.cwd()).free
        yield Line("disk", f"{free / 2**30:.0f} GiB free here; 5 million states take 0.4 to 1.9")
    yield Line("GPU", _gpu())
    yield Line("OpenGL", _opengl())
    address = os.environ.get("RAY_ADDRESS")
    yield Line("Ray", address or "no RAY_ADDRESS: study --backend ray starts one of its own")
    for extra in ("", *extras()):
        yield _packages(extra)


def _gpu() -> str:
    try:
        import torch
    except ModuleNotFoundError:
        return "not looked for, without torch"
    if not torch.cuda.is_available():
        return "none: train-dae takes the CPU, as do rl and study"
    device = torch.cuda.get_device_properties(0)
    memory = f"{device.total_memory / 2**30:.0f} GiB"
    return f"{device.name}, {memory}, CUDA {torch.version.cuda}: train-dae takes it"


def _opengl() -> str:
    """Try to render, in a separate process, since some drivers crash without OpenGL."""
    done = subprocess.run([sys.executable, "-c", _RENDER], capture_output=True, text=True)
    if done.returncode == 0:
        return f"{done.stdout.strip()}: render draws with it"
    reason = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
    return reason.partition("InputError: ")[2] or f"rendering fails: {reason}"


def _packages(extra: str) -> Line:
    """Whether all requirements of an extra are installed, in versions that fit."""
    name, asked = extra or "core", [(each, _installed(each)) for each in _required(extra)]
    wrong = [
        f"{r.name} {v} ({r.specifier} is needed)"
        for r, v in asked
        if v and not r.specifier.contains(v, prereleases=True)
    ]
    missing = [r.name for r, v in asked if not v]
    if not wrong and not missing:
        return Line(name, ", ".join(f"{r.name} {v}" for r, v in asked))
    problems = [*wrong, *([f"no {', '.join(missing)}"] if missing else [])]
    package = f"jbrep[{extra}]" if extra else "jbrep"
    said = f"{', '.join(problems)}: pip install '{package}'"
    return Line(name, said, is_wrong=bool(wrong) or not extra)


def _installed(requirement: Requirement) -> str:
    """The version that is there; empty if there is none."""
    try:
        return version(requirement.name)
    except PackageNotFoundError:
        return ""


def extras() -> list[str]:
    """The names of jbrep's extras."""
    return metadata("jbrep").get_all("Provides-Extra") or []


def _required(extra: str) -> Iterator[Requirement]:
    for requirement in map(Requirement, requires("jbrep") or ()):
        marker = requirement.marker
        if marker.evaluate({"extra": extra}) if marker else not extra:
            yield requirement


def extra_with(module: str) -> str | None:
    """The smallest extra that brings a module, for what to install; None if no extra does."""
    name = _DISTRIBUTIONS.get(module, module.replace("_", "-"))
    bringing = {extra: [r.name for r in _required(extra)] for extra in extras()}
    fitting = {extra: names for extra, names in bringing.items() if name in names}
    return min(fitting, key=lambda extra: len(fitting[extra]), default=None)
