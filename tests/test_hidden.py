"""An encoder of a history estimates what no sensor measures."""

import pytest
from command import jbrep, mistake

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.dataset import Dataset, DataSettings, ScaledDataset
from jbrep.envs import describe
from jbrep.evaluation import diagnose, regression
from jbrep.methods.fit import Fitter

SPEED = "obs_2"


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(regression, "_STEPS", 300)
        yield


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """A pendulum, whose speed is hidden in two other data sets."""
    folder = tmp_path_factory.mktemp("swing")
    settings = DataSettings(task=describe("Pendulum-v1"), steps=6000, seed=2)
    collect(settings, folder / "whole", num_threads=1)
    derive(folder / "whole", folder / "now", [SPEED])
    derive(folder / "whole", folder / "history", [SPEED], 2)
    return folder


def estimated(folder, view, latent):
    """R² of the hidden speed, and of the reward of 10 steps, from a code of what is seen."""
    data = ScaledDataset(Dataset(folder / view))
    encoder = Fitter(data, folder / view).fit("linear-forward", latent=latent).encoder
    evaluation = diagnose({"code": encoder}, data, truth=Dataset(folder / "whole"))
    assert evaluation.data.hidden == (SPEED,)
    known = evaluation.encoders["code"]
    return known.nonlinear_probes[SPEED].value, known.prediction["10"].reward.value


def test_a_code_of_a_history_tells_what_one_of_an_observation_does_not(swing):
    speed, reward = estimated(swing, "now", 2)
    of_history = estimated(swing, "history", 3)
    assert speed < 0.1
    assert of_history[0] > 0.9
    assert of_history[1] > reward + 0.3


def test_a_data_set_of_a_trained_policy_keeps_it(tmp_path):
    task = ("--task", "face_direction", "--episode-steps", 20)
    jbrep("collect", *task, "--policy", "trained", "--steps", 40, "--out", tmp_path / "whole")
    hidden = ("--hide", "*velocity*", "--out", tmp_path / "seen")
    assert jbrep("data", "derive", tmp_path / "whole", *hidden).exit_code == 0
    assert "no problems" in jbrep("data", "verify", tmp_path / "seen").output


def test_the_command_tells_it(swing, monkeypatch):
    monkeypatch.chdir(swing)
    train = ("train-encoder", "--kind", "linear-forward", "--latent", "3", "--data", "history")
    jbrep(*train, "--out", "encoders")
    encoder = "encoders/linear-forward-3.safetensors"
    judge = ("evaluate", "--encoder", encoder, "--data", "history", "--out", "judged")
    told = jbrep(*judge, "--truth", "whole").output
    assert "What isn't observed, predicted from the latent: R², nonlinear\n\nfeature  full" in told
    assert f"\n{SPEED}    " in told
    assert "is not an evaluation of these encoders" in mistake(*judge)


def test_the_truth_is_of_the_same_motion_and_shows_more(swing, tmp_path, monkeypatch):
    monkeypatch.chdir(swing)
    judge = ("evaluate", "--encoder", "full", "--data", "now", "--truth")
    assert "now shows nothing that now hides" in mistake(*judge, "now")
    settings = DataSettings(task=describe("Pendulum-v1"), steps=6000, seed=3)
    collect(settings, tmp_path / "other", num_threads=1)
    assert "has other actions than now: the truth must be" in mistake(*judge, tmp_path / "other")
