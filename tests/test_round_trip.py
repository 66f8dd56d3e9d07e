"""A policy drives a robot alone; the log of that is as good as the data set it stands for."""

from pathlib import Path

import numpy as np
import pytest
from command import jbrep

from jbrep import api
from jbrep.dataset import Dataset, ScaledDataset
from jbrep.envs import describe
from jbrep.evaluation import regression
from jbrep.evaluation.diagnosis import diagnose
from jbrep.methods.fit import Fitter
from jbrep.rl.controller import export, load_policy
from jbrep.rl.policy_file import find_shipped as find

EPISODES, STEPS = 16, 150
TASK = describe("face_direction", episode_steps=STEPS)
NAMED = ("--time", "time", "--episode", "trial", "--task", "face_direction")
SEEN = "position*,orientation*,velocity*,angular*,motor*,angle*"


@pytest.fixture(scope="module")
def trip(tmp_path_factory):
    """The returns of what drove alone, and beside its log the same episodes, collected."""
    folder = tmp_path_factory.mktemp("trip")
    export(load_policy(find(TASK)), folder / "controller.onnx")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path("examples/log").resolve())
        from record import record

        returns = record(str(folder / "controller.onnx"), folder / "walk.csv", EPISODES, STEPS)
    told = jbrep(
        *("data", "import", folder / "walk.csv", *NAMED, "--observations", SEEN),
        *("--episode-steps", STEPS, "--out", folder / "log"),
    )
    assert told.exit_code == 0, told.output
    assert f"{EPISODES} rows at the end of an episode, which has no next state" in told.output
    steps = EPISODES * STEPS
    return (
        returns,
        Dataset(folder / "log"),
        api.collect(TASK, folder / "collected", steps, policy="trained", threads=1),
    )


def test_a_policy_returns_alone_what_its_run_does(trip):
    """Of the same episodes; rounding parts a few of them."""
    returns, log, collected = trip
    np.testing.assert_allclose(log.episodes["return"], returns, rtol=1e-5)
    apart = np.abs(np.array(returns) - collected.episodes["return"])
    assert np.median(apart[:6]) < 0.05
    assert np.ptp(returns) > 10


def test_its_log_is_what_was_collected(trip):
    _, log, collected = trip
    assert log.task.features == collected.task.features
    assert log.task.max_episode_steps == STEPS
    np.testing.assert_array_equal(log.episodes["length"], collected.episodes["length"])
    for episode in range(EPISODES):
        ours, theirs = log.episode(episode), collected.episode(episode)
        for name in ("observation", "action", "reward"):
            apart = np.abs(ours[name][:20] - theirs[name][:20])
            assert (apart < 5e-3).mean() > 0.99, name  # but where an angle wraps


def test_an_encoder_of_the_log_is_as_good(trip, tmp_path, monkeypatch):
    monkeypatch.setattr(regression, "_STEPS", 200)
    _, *both = trip
    encoders = {
        data.folder.name: Fitter(ScaledDataset(data), tmp_path / data.folder.name)
        .fit("linear-forward", latent=8)
        .encoder
        for data in both
    }
    evaluation = diagnose(encoders, ScaledDataset(both[1]))
    log, collected = (evaluation.encoders[data.folder.name] for data in both)
    assert log.reconstruction.mse.value < 1.1 * collected.reconstruction.mse.value
    assert collected.scores["forward"].value > 0.1
    assert log.scores["forward"].value > collected.scores["forward"].value - 0.1
