"""Users' own encoders wherever an encoder is used: objects, functions, torch modules, code."""

from pathlib import Path

import gymnasium
import numpy as np
import pandas
import pytest
import torch
from command import jbrep, mistake, refused
from gymnasium.utils.env_checker import check_env
from sklearn.decomposition import PCA
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from small import ONE_EACH
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn
from wide import wide

from jbrep import Encoded, JitterbugVecEnv
from jbrep.encoders import find
from jbrep.encoders.base import as_encoder
from jbrep.envs import describe
from jbrep.envs.names import import_code
from jbrep.evaluation.diagnosis import diagnose
from jbrep.jitterbug import JitterbugEnv
from jbrep.rl import Run, train
from jbrep.rl.files import ENCODER
from jbrep.rl.policy import load_run

FACE = "Jitterbug/FaceDirection-v0"
TASK = describe("Pendulum-v1", episode_steps=20)
ROWS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)


class Half:
    """Encodes and can't decode."""

    latent_size = 2

    def encode(self, observation):
        return observation[:, :2] / 2


class Whole:
    """Encodes and decodes."""

    def encode(self, observation):
        return observation / 2

    def decode(self, latent):
        return latent * 2


def half(observation):
    """An encoder that is a function."""
    return Half().encode(observation)


def make_half():
    """A function that makes one."""
    return Half()


class Spoilt(Half):
    """Does as it is told from the given call on."""

    def __init__(self, what, after=3):
        self.what, self.left = what, after

    def encode(self, observation):
        self.left -= 1
        return self.what(observation) if self.left < 0 else super().encode(observation)


def only(**methods):
    """An object of a class with these alone."""
    return type("Odd", (), methods)()


def like(dtype):
    """A linear module of that type with weights of one half."""
    module = nn.Linear(3, 2, bias=False, dtype=dtype)
    nn.init.constant_(module.weight, 0.5)
    return module


class Unscaled(nn.Module):
    """A module without parameters, with whole numbers alone."""

    def __init__(self):
        super().__init__()
        self.register_buffer("seen", torch.tensor([1]))

    def forward(self, observation):
        return observation.sum(1, keepdim=True).repeat(1, 2) / 2


def test_a_transformer_of_scikit_learn_is_an_encoder():
    rows = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    fitted = make_pipeline(StandardScaler(), PCA(2)).fit(rows)
    encoder = as_encoder(fitted, describe("Pendulum-v1"))
    assert (encoder.name, encoder.latent_size) == ("Pipeline", 2)
    np.testing.assert_allclose(encoder.encode(rows), fitted.transform(rows), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        encoder.decode(encoder.encode(rows)),
        fitted.inverse_transform(fitted.transform(rows)),
        rtol=1e-4,
        atol=1e-5,
    )
    frame = pandas.DataFrame(rows, columns=["cos", "sin", "speed"])
    of_frame = as_encoder(PCA(2).fit(frame), describe("Pendulum-v1"))  # warns of nothing
    assert of_frame.encode(rows).shape == (200, 2)


@pytest.mark.parametrize(
    "given",
    [
        lambda rows: rows.sum(1, keepdims=True).repeat(2, 1) / 2,
        lambda rows: (rows.sum(1, keepdims=True).repeat(2, 1) / 2).astype(np.float64).tolist(),
        *(like(dtype) for dtype in (torch.float32, torch.float64, torch.bfloat16)),
        Unscaled(),
    ],
)
def test_whatever_encodes_is_an_encoder(given):
    encoder = as_encoder(given, TASK)
    assert (encoder.latent_size, encoder.kind, encoder.can_decode) == (2, "own", False)
    expected = np.tile(ROWS.sum(1, keepdims=True) / 2, 2)
    for rows in (ROWS, ROWS[0], ROWS[None, :, None], ROWS[:0], np.asarray(ROWS, np.float64)):
        latent = encoder.encode(rows)
        assert (latent.dtype, latent.shape) == (np.float32, (*rows.shape[:-1], 2))
    np.testing.assert_allclose(encoder.encode(ROWS), expected, atol=0.03)  # bfloat16


def test_a_module_is_used_in_evaluation_mode_and_left_as_it_was():
    norm, frozen = nn.BatchNorm1d(3), nn.Dropout(0.5).eval()
    module = nn.Sequential(norm, nn.Dropout(0.9), frozen, nn.Linear(3, 2))
    before = {name: value.clone() for name, value in module.state_dict().items()}
    encoder = as_encoder(module, TASK)
    np.testing.assert_array_equal(encoder.encode(ROWS), encoder.encode(ROWS))
    assert [part.training for part in module.modules()] == [True, True, True, False, True]
    assert all((value == before[name]).all() for name, value in module.state_dict().items())
    assert torch.is_grad_enabled()
    module(torch.zeros(4, 3)).sum().backward()  # it can still learn


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (only(), "Odd has neither"),
        (Half, "Half is a class"),
        (PCA(2), "PCA failed: NotFittedError"),
        (only(encode=Half.encode, latent_size=4), "latent_size is 4"),
        (Spoilt(lambda rows: (rows, rows), 0), "tuple"),
        (Spoilt(lambda rows: rows[0], 0), "shape (3,)"),
        (Spoilt(lambda rows: rows[:, :0], 0), "no numbers"),
        (Spoilt(lambda rows: rows.astype(float) * 1e300, 0), "not finite"),
        (Spoilt(lambda rows: rows[:, 1:], 1), "the next time"),
        (lambda rows: rows - rows.mean(0), "a batch of one"),
        (only(encode=Half.encode, check_task=lambda self, task: 1 / 0), "Odd refuses Pendulum-v1"),
        (as_encoder(Half(), describe("face_direction")), "of 16 numbers"),
    ],
)
def test_what_is_no_encoder_is_refused_in_one_line(given, message):
    assert message in refused(as_encoder, given, TASK)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda rows: rows, "shape (5, 3)"),
        (lambda rows: rows[:, :2] * np.nan, "not finite"),
        (lambda rows: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_an_encoder_is_checked_at_every_call(what, message):
    assert message in refused(as_encoder(Spoilt(what), TASK).encode, ROWS)


@pytest.mark.parametrize("name", ["test_own:Half", "test_own:half", "test_own:make_half"])
def test_code_is_a_class_or_a_function_that_makes_an_encoder_or_is_one(name):
    import_code(name)
    np.testing.assert_array_equal(find(name, TASK).encode(ROWS), ROWS[:, :2] / 2)


def test_an_encoder_without_decoder_is_evaluated_but_for_what_it_loses():
    data = wide([300, 250, 99, 180], features=4)
    evaluation = diagnose({"half": Half(), "whole": Whole(), "module": nn.Linear(4, 6)}, data)
    assert evaluation.seen == dict.fromkeys(("half", "whole", "module"), "maybe")
    own = evaluation.encoders
    assert own["half"].reconstruction is None
    assert own["half"].scores["forward"].value is not None
    assert own["whole"].reconstruction.mse.value < 1e-9
    probe = own["whole"].nonlinear_probes["obs_1"].value
    assert probe == pytest.approx(own["full"].nonlinear_probes["obs_1"].value, rel=1e-6)
    assert (own["module"].kind, own["module"].latent) == ("own", 6)
    assert "Half has no decoder" in refused(as_encoder(Half(), TASK).decode, ROWS[:, :2])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run on code, and one on an object."""
    folder = tmp_path_factory.mktemp("own")
    import_code("test_own:Half")
    for name, encoder in (("code", "test_own:Half"), ("object", Whole())):
        run = Run.of(
            task=TASK, algorithm="a2c", encoder=encoder, steps=20, preset="paper", **ONE_EACH
        )
        train(run, folder / name)
    return folder


def test_a_run_on_code_is_played_once_its_module_may_run(trained, monkeypatch):
    run, played = trained / "code", ("evaluate-policy", trained / "code", "--episodes", 1)
    assert not (run / ENCODER).exists()
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    assert "--import test_own" in mistake(*played)
    assert "Whole" in mistake(*played, "--encoder", "test_own:Whole")
    assert "on Half: median" in jbrep(*played, "--encoder", "test_own:Half").output
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    assert "on Half: median" in jbrep(*played, "--import", "test_own").output
    monkeypatch.setattr(Half, "encode", lambda self, rows: rows[:, :2] / 3)
    assert "is not the encoder that the run in" in refused(load_run, run)


def test_a_run_on_an_object_needs_it_again(trained):
    folder = trained / "object"
    assert load_run(folder, Whole()).representation == "Whole"
    assert "encoder" in refused(load_run, folder)
    assert "Half is not the encoder that the run in" in refused(load_run, folder, Half())


def one(**options):
    """A Jitterbug with short episodes."""
    return gymnasium.make(FACE, max_episode_steps=10, **options)


@pytest.mark.filterwarnings("ignore::UserWarning")  # of unbounded observations, of the wrapper
def test_an_encoded_environment_shows_latents():
    env = Encoded(one(), "dae-8")
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (8,), np.float32)
    assert env.task == describe("face_direction", episode_steps=10)
    check_env(env)
    again = gymnasium.make(env.spec)
    np.testing.assert_array_equal(again.reset(seed=3)[0], env.reset(seed=3)[0])


@pytest.mark.parametrize("num_envs", [1, 3])
def test_latents_are_those_of_the_vec_env_to_the_bit(num_envs):
    ours = JitterbugVecEnv("face_direction", num_envs, 3, find("dae-8", "face_direction"), 1, 10)
    if num_envs == 1:
        theirs = DummyVecEnv([lambda: Encoded(one(), "dae-8")])
        theirs.seed(3)
        first = theirs.reset()
    else:
        theirs = Encoded(gymnasium.make_vec(FACE, num_envs=3, max_episode_steps=10), "dae-8")
        first, _ = theirs.reset(seed=3)
    np.testing.assert_array_equal(first, ours.reset())
    assert (
        first in theirs.observation_space if num_envs > 1 else first[0] in theirs.observation_space
    )
    action = np.full((num_envs, 1), 0.3, np.float32)
    for step in range(10):
        seen, (latent, _, _, infos) = theirs.step(action), ours.step(action)
        if step < 9:
            np.testing.assert_array_equal(seen[0], latent)
    for index, info in enumerate(infos):
        final = seen[3][0]["terminal_observation"] if num_envs == 1 else seen[4]["final_obs"][index]
        np.testing.assert_array_equal(final, info["terminal_observation"])


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: one(scaled=True), "scaled already"),
        (lambda: JitterbugEnv("face_direction"), "without a spec"),
        (lambda: gymnasium.make("Jitterbug/MoveToPose-v0"), "face_direction"),
        (lambda: gymnasium.wrappers.NormalizeObservation(one()), "NormalizeObservation"),
    ],
)
def test_environments_that_an_encoder_can_t_read(env, message):
    file = Path("jbrep/encoders/shipped/face_direction/dae-8.safetensors")
    assert message in refused(Encoded, env(), file)
