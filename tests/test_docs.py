"""The Python in README and docs runs as it stands; the commands there exist."""

import re
import shlex
import tomllib
from pathlib import Path

import click
import gymnasium
import pytest
from command import in_this_process
from key_table import key_table

from jbrep.cli import main
from jbrep.coordinates import make_coordinates
from jbrep.dataset.layout import Layout
from jbrep.encoders.header import EncoderHeader
from jbrep.envs import describe
from jbrep.evaluation import evaluation
from jbrep.rl.settings import TrainingSettings
from jbrep.stats.rules import Rules
from jbrep.studies.config import Data, Study, as_study
from jbrep.studies.runner import BACKENDS

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / name for name in ("README.md", "data/README.md", "CONTRIBUTING.md")]
PAGES += [*sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("results/**/*.md"))]


def found(pattern):
    """What matches in each page, as parameters of a test."""
    return [
        pytest.param(match, id=f"{page.name}-{i}")
        for page in PAGES
        for i, match in enumerate(re.findall(pattern, page.read_text(), re.M | re.S))
    ]


PYTHON = found(r"^```python\n(.*?)^```")
(ENVIRONMENT,) = (block for block in PYTHON if "Env)" in block.values[0])
(NUMBERS,) = (block for block in PYTHON if "genfromtxt" in block.values[0])  # in test_verdicts


@pytest.mark.usefixtures("one_figure")
@pytest.mark.filterwarnings("ignore:This study:jbrep.errors.Notice")  # that it is a small one
@pytest.mark.parametrize(
    "block", [block for block in PYTHON if block not in (ENVIRONMENT, NUMBERS)]
)
def test_the_python_runs(block, monkeypatch, tmp_path):
    for name in ("data", "jbrep", "results"):  # what is read; what is written stays out of here
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    less = block.replace("evaluation_episodes=1", "evaluation_episodes=1, final_episodes=1")
    exec(compile(less, "block", "exec"), {})


@pytest.fixture(autouse=True)
def registered_again(monkeypatch):
    """What a block registers, another may register, too."""
    monkeypatch.setattr(evaluation, "_REGISTERED", [*evaluation._REGISTERED])
    yield
    gymnasium.registry.pop("Cart-v0", None)
    evaluation.SCALARS.pop("farthest", None)


TOML = found(r"^```toml\n(.*?)^```")
FEATURES = [block for block in TOML if "[[features]]" in block.values[0]]
OTHERS = [*FEATURES, *(block for block in TOML if "[tool.jbrep]" in block.values[0])]


@pytest.mark.parametrize("block", [block for block in TOML if block not in OTHERS])
def test_the_studies_are_studies(block):
    given = tomllib.loads(block)
    assert as_study(given).seeds == tuple(range(given["seeds"]))


@pytest.mark.filterwarnings("ignore:sac-wide learns from step")
def test_the_features_are_those_of_the_environment_shown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(*ENVIRONMENT.values, "block", "exec"), {})
    cart, turning = sorted((block.values[0] for block in FEATURES), key=lambda text: "kind" in text)
    path = tmp_path / "features.toml"
    path.write_text(cart)
    task = describe("Cart-v0", features=path)
    assert [(f.name, f.unit) for f in task.features] == [("position", "m"), ("speed", "m/s")]
    path.write_text(turning + cart[cart.rindex("[[features]]") :])  # the heading in place of x
    made = make_coordinates(describe("Cart-v0", features=path), "coordinates")
    assert made.names == ("heading.cos", "heading.sin", "speed")
    assert (task.reward_high, task.timestep, task.reproducible) == (0, 0.1, True)


SHARED = ("data", "learners", "verdicts", "described", "environment")


@pytest.mark.parametrize(
    ("page", "table"),
    [
        ("encoder-file", key_table(EncoderHeader)),
        ("keys", key_table(TrainingSettings)),
        ("logs", key_table(Layout)),
        ("keys", key_table(Study, without=(*TrainingSettings.__struct_fields__, *SHARED))),
        ("keys", key_table(Data, of="data")),
        ("keys", key_table(Rules, of="verdicts")),
    ],
)
def test_the_tables_of_keys_are_those_of_the_records(page, table):
    assert table in (ROOT / f"docs/{page}.md").read_text()


@pytest.mark.parametrize("line", found(r"^ {4}jbrep ([^\n]*)"))
def test_the_commands_are_typed_as_they_are_understood(line, monkeypatch):
    monkeypatch.setattr("jbrep.envs.names.import_modules", lambda modules: None)  # a reader's own
    words, command = shlex.split(line, comments=True), main
    while isinstance(command, click.Group):
        name, *words = words
        command = command.commands[name]
    command.make_context(name, words)  # refuses what it doesn't know


def test_every_command_is_shown_and_every_command_shown_exists():
    everywhere = "".join(page.read_text() for page in PAGES)
    page = (ROOT / "docs/commands.md").read_text()
    for group, name, text in ((main, "", page), (main.commands["data"], "data ", everywhere)):
        shown = set(re.findall(rf"^ {{4}}jbrep {name}([a-z-]+)", text, re.M))
        assert shown == set(group.commands)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page):
    targets = [t for t in re.findall(r"\]\(([^)]+)\)", page.read_text()) if "://" not in t]
    for path, _, heading in (target.partition("#") for target in targets):
        there = page.parent / path if path else page
        assert there.exists(), path
        if heading:  # which is called by GitHub's rule
            titles = re.findall(r"^#+ (.*)", there.read_text().lower(), re.M)
            anchors = {re.sub(r"[^\w\- ]", "", title).replace(" ", "-") for title in titles}
            assert heading in anchors, f"{path}#{heading}"


def test_the_citation_is_of_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text()
