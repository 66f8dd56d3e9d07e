"""What is installed without the repository."""

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
BUILD = ("pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")


def test_a_wheel_has_every_file_of_the_package(tmp_path):
    """Built from what git knows, as a release is, so that nothing in the working tree helps."""
    source = tmp_path / "source"
    subprocess.run(["git", "clone", "--quiet", "--depth=1", f"file://{ROOT}", source], check=True)
    subprocess.run([sys.executable, "-m", *BUILD, "-w", tmp_path, source], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    tracked = {path for path in source.glob("jbrep/**/*") if path.is_file()}
    wanted = {str(path.relative_to(source)) for path in tracked if "__pycache__" not in path.parts}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("jbrep/")}
    assert packed == wanted
