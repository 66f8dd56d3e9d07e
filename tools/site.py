"""Build the documentation as a site: python tools/site.py build/site.

Pages link to each other, to results and to source files as they lie in the repository, so the site
is built from a copy of these; a link that leads nowhere ends it with code 1.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
SHOWN = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "LICENSE", "docs")
BEHIND = ("results", "examples", "studies", "jbrep", "benchmarks", "data/sample")  # their links


def main() -> None:
    out = Path(sys.argv[1]).resolve()
    listed = ["git", "ls-files", "-z", "--", *SHOWN, *BEHIND]
    names = subprocess.run(listed, cwd=HERE, capture_output=True, text=True, check=True).stdout
    with tempfile.TemporaryDirectory() as temporary:
        pages = Path(temporary) / "pages"
        for name in names.rstrip("\0").split("\0"):
            if not name.endswith((".safetensors", ".h5")):
                (pages / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(HERE / name, pages / name)
        shutil.copy(HERE / "docs" / "zensical.toml", temporary)
        build = [sys.executable, "-m", "zensical", "build", "--strict"]
        subprocess.run(build, cwd=temporary, check=True)
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(Path(temporary) / "site", out)


if __name__ == "__main__":
    main()
