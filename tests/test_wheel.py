"""What is installed without the repository."""

import subprocess
import sys
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

ROOT = Path(__file__).parent.parent
BUILD = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"


def test_a_wheel_has_every_file_of_the_package(tmp_path):
    """Built from what git knows, as a release is, so that nothing in the working tree helps."""
    source = tmp_path / "source"
    subprocess.run(["git", "clone", "--quiet", "--depth=1", f"file://{ROOT}", source], check=True)
    command = [sys.executable, "-c", BUILD, tmp_path]
    subprocess.run(command, cwd=source, stdout=subprocess.DEVNULL, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    tracked = {path for path in source.glob("jbrep/**/*") if path.is_file()}
    wanted = {str(path.relative_to(source)) for path in tracked if "__pycache__" not in path.parts}
    archive = zipfile.ZipFile(wheel)
    packed = {name for name in archive.namelist() if name.startswith("jbrep/")}
    assert packed == wanted
    assert "jbrep/py.typed" in packed
    (path,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    said = message_from_bytes(archive.read(path))
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for key in ("name", "version", "author", "license-expression", "description-content-type"):
        assert said[key], key
    assert (said["name"], said["requires-python"]) == ("jbrep", given["requires-python"])
    assert said["version"] == given["version"]
    assert said.get_payload(decode=True).decode() == (ROOT / "README.md").read_text()
    assert set(said.get_all("provides-extra")) == given["optional-dependencies"].keys()
    assert "Typing :: Typed" in said.get_all("classifier")
    (commands,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
    assert b"jbrep = jbrep.cli:main" in archive.read(commands)
