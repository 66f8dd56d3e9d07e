"""Build the documentation as a site: python tools/site.py build/site.

Pages link to each other, to results and to source files as they lie in the repository, so the site
is built from a copy of these; a link that leads nowhere ends it with code 1. A notebook, which is a
script with marks of cells, becomes a page beside it.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
SHOWN = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "CITATION.cff", "LICENSE")
FOLDERS = ("docs", "results", "examples", "studies", "jbrep", "benchmarks", "data/sample")
LEFT_OUT = shutil.ignore_patterns("*.safetensors", "*.h5", "__pycache__")


def main() -> None:
    out = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as temporary:
        pages = Path(temporary) / "pages"
        for name in FOLDERS:
            shutil.copytree(HERE / name, pages / name, ignore=LEFT_OUT)
        for name in SHOWN:
            shutil.copy(HERE / name, pages)
        for notebook in pages.glob("examples/*/notebook.py"):
            notebook.with_suffix(".md").write_text(page_of(notebook.read_text()))
        shutil.copy(HERE / "docs" / "zensical.toml", temporary)
        build = [sys.executable, "-m", "zensical", "build", "--strict"]
        subprocess.run(build, cwd=temporary, check=True)
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(Path(temporary) / "site", out)


def page_of(notebook: str) -> str:
    """The cells of a notebook as Markdown."""
    cells = re.split(r"^# %%(.*)\n", notebook, flags=re.M)[1:]
    return "\n\n".join(
        re.sub("^# ?", "", text.strip(), flags=re.M)
        if "markdown" in mark
        else f"```python\n{text.strip()}\n```"
        for mark, text in zip(cells[::2], cells[1::2], strict=True)
    )


if __name__ == "__main__":
    main()
