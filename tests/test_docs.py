"""The Python in README and docs runs as it stands; the commands there exist."""

import re
from pathlib import Path

import pytest

from jbrep.cli import main

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "data" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCKS = [
    pytest.param(block, id=f"{page.name}-{i}")
    for page in PAGES
    for i, block in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S))
]


@pytest.mark.usefixtures("episode_steps")
@pytest.mark.parametrize("block", BLOCKS)
def test_the_python_runs(block, monkeypatch, tmp_path):
    for name in ("data", "jbrep"):  # what the blocks read; what they write stays out of here
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "block", "exec"), {})


def test_every_command_is_shown_and_every_command_shown_exists():
    shown = set(re.findall(r"^ {4}jbrep ([a-z-]+)", (ROOT / "README.md").read_text(), re.M))
    assert shown == set(main.commands)


def test_every_data_command_is_shown_and_every_one_shown_exists():
    text = "".join(page.read_text() for page in PAGES)
    shown = set(re.findall(r"^ {4}jbrep data ([a-z-]+)", text, re.M))
    assert shown == set(main.commands["data"].commands)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)#]+)\)", page.read_text())
    assert not [t for t in targets if "://" not in t and not (page.parent / t).exists()]
