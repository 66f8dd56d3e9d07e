"""What is told of a machine."""

import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, version
from itertools import chain
from pathlib import Path

from command import jbrep
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from jbrep import doctor


def test_every_extra_is_examined(monkeypatch):
    monkeypatch.setattr(doctor, "_opengl", lambda: "not tried")
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    assert set(doctor.extras()) == {*project["optional-dependencies"]}
    text = " ".join(jbrep("doctor").output.split())
    for name in ("numpy", "mujoco", "torch", "pillow"):
        assert f"{name} {version(name)}" in text


def test_a_module_is_known_by_the_extra_that_brings_it():
    modules = ("PIL", "sklearn", "rerun", "torch", "ray", "numpy", "fly")
    extras = ["render", "learn", "view", "learn", "cluster", None, None]
    assert [doctor.extra_with(module) for module in modules] == extras


CORE_ALONE = """
import sys

class Missing:
    def find_spec(self, name, path, target=None):
        if name in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

folder, *missing = sys.argv[1:]
sys.meta_path.insert(0, Missing())
from jbrep.cli import main
for command in ("collect --task face_direction --steps 1000 --out", "data verify", "data info"):
    try:
        main([*command.split(), folder])
    except SystemExit as ended:
        assert not ended.code, command
"""


def test_without_any_extra_states_are_collected_and_read(tmp_path):
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]

    def distributions(requirements):
        return {canonicalize_name(Requirement(each).name) for each in requirements}

    extras = distributions(chain.from_iterable(project["optional-dependencies"].values()))
    left_out = extras - distributions(project["dependencies"])
    modules = [
        module
        for module, brought_by in packages_distributions().items()
        if {*map(canonicalize_name, brought_by)} <= left_out
    ]
    assert {"torch", "sklearn", "rosbags"} <= {*modules}
    command = [sys.executable, "-c", CORE_ALONE, tmp_path / "data", *modules]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1,000 rows" in done.stdout
