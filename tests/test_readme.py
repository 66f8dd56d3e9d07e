"""The commands of README, and of docs/worth.md, one after the other, each with less work to do."""

import os
import re
import shlex
import sys
from pathlib import Path

import gymnasium
import pytest
from command import in_this_process, jbrep

from jbrep.dataset import Dataset
from jbrep.evaluation import regression
from jbrep.rl.files import read_run
from jbrep.studies.runner import BACKENDS

ROOT = Path(__file__).parent.parent
EPISODES = {"--evaluation-episodes": "1", "--final-episodes": "1"}
LESS = {  # by command: numbers in place of a page's, or beside them
    "check": {"--steps": "1k"},
    "collect": {"--steps": "1k", "--episode-steps": "100"},
    "train-dae": {"--epochs": "2"},
    "train-encoder": {},
    "rl": {"--steps": "200", "--episode-steps": "100", **EPISODES},
    "clone": {"--steps": "50", "--episodes": "2"},
}
STUDY = {"seeds": "1", "steps": "100", "evaluate_every": "100"}
STUDY |= {"evaluation_episodes": "1", "final_episodes": "2"}
MY_ROBOT = """
import gymnasium

if "MyRobot-v0" not in gymnasium.registry:
    hopper = "gymnasium.envs.mujoco.hopper_v5:HopperEnv"
    gymnasium.register("MyRobot-v0", hopper, max_episode_steps=100)
"""
LOG = "t,angle,cmd_0\n" + "".join(
    f"{i / 50 + i // 100 * 9},{i % 7},{i % 3}\n"
    for i in range(500)  # with pauses
)


def commands(page, section=""):
    """A page's, in order; of a section, those under its heading."""
    text = (ROOT / page).read_text()
    text = text.partition(section)[2].partition("\n#")[0] if section else text
    return [
        shlex.split(line, comments=True) for line in re.findall(r"^ {4}jbrep (.*)$", text, re.M)
    ]


def lessened(words):
    """The same command with less to do."""
    for option, value in LESS.get(words[0], {}).items():
        if option in words:
            words[words.index(option) + 1] = value
        else:
            words += [option, value]
    return words


@pytest.mark.usefixtures("one_figure")
@pytest.mark.filterwarnings("ignore")  # of encoders with two epochs, of very short runs
def test_the_commands_of_the_readme_follow_one_another(tmp_path, monkeypatch):
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    (tmp_path / "my_package.py").write_text(MY_ROBOT)
    (tmp_path / "log.csv").write_text(LOG)
    demo = (ROOT / "jbrep/studies/shipped/demo.toml").read_text().replace("20_000", "2_000")
    (mine,) = re.findall(r"^```toml\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S)
    for path, study in (("demo", demo), ("mine.toml", mine)):
        for key, value in STUDY.items():
            study = re.sub(rf"^{key} = .*\n", "", study, count=1, flags=re.M)
            study = f"{key} = {value}\n{study}"
        (tmp_path / path).write_text(f"episode_steps = 100\n{study}")
    try:
        for words in commands("README.md"):
            told = jbrep(*lessened(words))
            assert told.exit_code == 0, (words, told.output)
    finally:
        sys.modules.pop("my_package", None)
        gymnasium.registry.pop("MyRobot-v0", None)
    for made in ("features.toml", "mine.onnx", "runs/demo/report.html", "runs/clone/run.json"):
        assert (tmp_path / made).stat().st_size, made


@pytest.mark.filterwarnings("ignore")  # of very short runs
def test_an_agents_own_data_lead_to_a_latent_and_to_an_agent_on_it(tmp_path, monkeypatch):
    monkeypatch.setattr(regression, "_STEPS", 100)
    monkeypatch.chdir(tmp_path)
    for words in commands("docs/representations.md", "### Data that show the task"):
        told = jbrep(*lessened(words))
        assert told.exit_code == 0, (words, told.output)
    policy = Dataset("data/own").manifest.settings.policy
    assert [part["kind"] for _, part in policy["parts"]] == ["uniform", "trained"]
    assert read_run(tmp_path / "runs/small").latent_size == 8


@pytest.mark.slow
@pytest.mark.usefixtures("one_figure")
@pytest.mark.filterwarnings("ignore")  # of very short runs
def test_ten_minutes_lead_from_a_robot_to_a_code(tmp_path, monkeypatch):
    """By the data alone, and by a study of small agents."""
    monkeypatch.setitem(BACKENDS, "local", in_this_process)
    monkeypatch.setattr(regression, "_STEPS", 100)
    monkeypatch.chdir(tmp_path)
    (study,) = re.findall(r"^```toml\n(.*?)^```", (ROOT / "docs/worth.md").read_text(), re.M | re.S)
    for key, value in STUDY.items():
        study = re.sub(rf"^{key} = .*\n", "", study, count=1, flags=re.M)
        study = f"{key} = {value}\n{study}"
    (tmp_path / "choice.toml").write_text(study.replace("steps = 20_000", "steps = 2_000"))
    told = [jbrep(*words) for words in map(lessened, commands("docs/worth.md"))]
    assert [each.exit_code for each in told] == [0] * len(told), told
    assert re.search(r"(Recommended|No encoder)", told[4].output)
    for code in ("full", "forward-6", "forward-4", "pca-6", "slow-6"):
        assert re.search(rf"\b{code} .*(finished|-)", told[-1].output)
    assert (tmp_path / "runs/arm/run.json").stat().st_size
