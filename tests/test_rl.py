"""One run: settings, files, evaluation, kills and stops, failures, and files from elsewhere."""

import hashlib
import io
import json
import pickle
import shutil
import subprocess
import sys
import time
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from command import wait_for
from small import assert_same_files, forge
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecMonitor
from tensors import torch_threads

from jbrep.encoders import find
from jbrep.envs import Environments, describe
from jbrep.envs.recording import Outcome, outcome
from jbrep.errors import InputError
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.agent import ColouredActionNoise, evaluate, make_agent, make_env, training_seed
from jbrep.rl.files import EVALUATION_SEED, FAILED, FINISHED, POLICY, read_evaluations, read_run
from jbrep.rl.history import Bar, History
from jbrep.rl.policy import load_run
from jbrep.rl.presets import ALGORITHMS, get_preset, sb3_class

STEPS = 100  # of an episode: little depends on its length
TASK = describe("face_direction", episode_steps=STEPS)
QUICK = {"task": TASK, "evaluation_episodes": 1, "final_episodes": 2}
# to evaluate the text of a run
IMPORTS = "from msgspec import UNSET; from jbrep.envs import Feature, Task; "
IMPORTS += "from jbrep.rl.learner import Learner"
SHORT = Run.of(algorithm="a2c", encoder="dae-8", steps=80, **QUICK, preset="paper")


def agent_of(algorithm, preset="paper", encoder="dae-8"):
    settings = get_preset(preset, algorithm)
    env = make_env(TASK, settings, 0, find(encoder, TASK))
    return make_agent(algorithm, settings, env, seed=0)


def widths(network):
    return [m.out_features for m in network.modules() if isinstance(m, torch.nn.Linear)]


def assert_same_run(one, other):
    assert_same_files(one, other, "episodes.csv", "evaluations.csv", "policy.zip", POLICY)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    folder = tmp_path_factory.mktemp("short")
    train(SHORT, folder)
    return folder


def test_table_one_reaches_ddpg():
    agent = agent_of("ddpg")
    assert agent.lr_schedule(1) == agent.lr_schedule(0) == 1e-4
    assert (agent.gamma, agent.batch_size, agent.gradient_steps) == (0.99, 256, 50)
    assert (agent.train_freq.frequency, agent.train_freq.unit.value) == (100, "step")
    assert (agent.replay_buffer.buffer_size, agent.tau) == (1_000_000, 1e-3)
    noise = agent.action_noise
    assert isinstance(noise, OrnsteinUhlenbeckActionNoise)
    assert (noise._mu, noise._sigma, noise._theta) == (0.3, 0.3, 0.15)
    for network in (agent.actor, agent.critic):
        assert widths(network) == [350, 250, 1]
        assert isinstance(network.optimizer, torch.optim.Adam)
        assert network.optimizer.param_groups[0]["lr"] == 1e-4
        assert sum(isinstance(m, torch.nn.ReLU) for m in network.modules()) == 2


def test_table_one_reaches_ppo():
    agent = agent_of("ppo")
    assert agent.lr_schedule(1) == agent.lr_schedule(0) == 1e-4
    assert (agent.gamma, agent.n_steps, agent.ent_coef, agent.vf_coef) == (0.99, 256, 0.01, 0.5)
    assert (agent.max_grad_norm, agent.gae_lambda, agent.n_epochs) == (0.5, 0.95, 4)
    assert (agent.clip_range(1), agent.clip_range(0), agent.clip_range_vf) == (0.2, 0.2, None)
    assert agent.n_steps * agent.n_envs / agent.batch_size == 4
    extractor = agent.policy.mlp_extractor
    assert widths(extractor.policy_net) == widths(extractor.value_net) == [350, 250]
    assert isinstance(extractor.policy_net[1], torch.nn.ReLU)
    assert isinstance(agent.policy.optimizer, torch.optim.Adam)
    assert agent.policy.optimizer.param_groups[0]["eps"] == 1e-5  # as without a preset


@pytest.mark.parametrize(
    ("algorithm", "preset"),
    [(each, name) for each, its in ALGORITHMS.items() for name in its.presets],
)
def test_every_preset_makes_an_agent_with_adam(algorithm, preset):
    agent = agent_of(algorithm, preset)
    optimizers = [
        m.optimizer for m in (agent.policy, *agent.policy.children()) if hasattr(m, "optimizer")
    ]
    assert optimizers
    assert {type(o) for o in optimizers} == {torch.optim.Adam}
    expected = (ALGORITHMS[algorithm].presets[preset].num_envs, 1)
    assert agent.predict(agent.env.reset())[0].shape == expected


def test_a_runs_folder(short):
    run = read_run(short)
    assert run.status == FINISHED
    assert run.steps == 80
    assert run.settings.representation == "dae-8"
    assert run.settings.hyperparameters.net_arch == (350, 250)
    assert {"torch", "mujoco", "stable-baselines3"} <= set(run.versions)
    assert run.seconds > 0
    assert run.cpu
    played = [(e.step, e.episode) for e in read_evaluations(short)]
    assert played == [(0, 0), (80, 0), (80, 1)]
    assert (short / "episodes.csv").read_text() == "step,env,return,length,diverged\n"
    assert list((short / "tensorboard").glob("events.*"))
    assert not (short / "checkpoint.safetensors").exists()


def test_plain_sb3_loads_the_policy_that_was_evaluated(short):
    plain = sb3_class("a2c").load(short / "policy.zip", device="cpu")
    trained = load_run(short)
    encoder = find("dae-8", TASK)
    rows = encoder(np.random.default_rng(0).normal(size=(50, 16)).astype(np.float32))
    expected = plain.predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(trained.policy.predict(rows, deterministic=True)[0], expected)
    returns = outcome(Environments(TASK, 1), trained.begin(TASK, [0]), EVALUATION_SEED).returns
    at_end = [e.episode_return for e in read_evaluations(short) if e.step == 80]
    np.testing.assert_allclose(returns, at_end[:1], atol=5e-4)


def test_evaluation_is_the_deterministic_policys_return():
    agent = agent_of("ppo")
    encoder = find("dae-8", TASK)
    envs, total = Environments(TASK, 2), np.zeros(2)
    envs.reset([0, 1], [EVALUATION_SEED, EVALUATION_SEED + 1])
    for _ in range(STEPS):
        latent = encoder(envs.observation.astype(np.float32))
        total += envs.step(agent.predict(latent, deterministic=True)[0]).reward
    envs = Environments(TASK, 2)
    for _ in range(2):  # the same episodes each time
        returns = evaluate(agent, envs, encoder, 2).returns
        np.testing.assert_allclose(returns, total, rtol=1e-5)


def test_training_episodes_are_recorded_and_evaluation_leaves_no_trace(tmp_path):
    run = SHORT.replace(steps=880)
    for name, every in (("often", 400), ("never", 10_000)):
        train(run.replace(evaluate_every=every), tmp_path / name)
    often, never = tmp_path / "often", tmp_path / "never"
    assert_same_files(often, never, "episodes.csv", "policy.zip")
    steps = [0, 400, 800, 880]
    assert sorted({e.step for e in read_evaluations(often)}) == steps
    rows = [line.split(",") for line in (often / "episodes.csv").read_text().splitlines()[1:]]
    assert [(row[0], row[1], row[3], row[4]) for row in rows] == [
        ("800", str(index), f"{STEPS}", "0") for index in range(8)
    ]
    assert len({row[2] for row in rows}) > 4


def test_training_starts_from_these_seeds_whatever_the_agent_seeds(tmp_path, monkeypatch):
    reset, starts = VecMonitor.reset, []
    monkeypatch.setattr(VecMonitor, "reset", lambda env: starts.append(reset(env)) or starts[-1])
    train(SHORT.replace(seed=3), tmp_path / "run")
    expected = make_env(
        TASK, get_preset("paper", "a2c"), training_seed(3), find("dae-8", TASK)
    ).venv.reset()
    assert [np.array_equal(start, expected) for start in starts if len(start) == 8] == [True]


def test_neither_threads_nor_clock_change_a_bit(short, tmp_path, monkeypatch):
    """Nor does the process: the next but one begins in another."""
    with torch_threads(2), monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: 1 << 33)  # zip files can't be dated after 2107
        train(SHORT, tmp_path)
    assert_same_run(short, tmp_path)


def test_a_finished_run_is_left_alone(short):
    before = {p: p.stat().st_mtime_ns for p in short.iterdir()}
    assert train(SHORT, short).status == FINISHED
    with pytest.raises(InputError, match=r"holds another run: seed 0 \(now: 5\)"):
        train(SHORT.replace(seed=5), short)
    assert {p: p.stat().st_mtime_ns for p in short.iterdir()} == before


KILLED = Run.of(algorithm="ddpg", encoder="dae-8", steps=300, **QUICK, preset="paper")


def test_a_killed_run_resumes_to_the_same_bits(tmp_path):
    """Killed in a process of its own, when it has written two checkpoints."""
    folder = tmp_path / "killed"
    text = (
        f"from pathlib import Path; from jbrep.rl import Run, Session, train; {IMPORTS};"
        f"train({KILLED!r}, Path({str(folder)!r}), Session(save_every=0.05))"
    )
    process = subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True)
    seen, path = set(), folder / "checkpoint.safetensors"

    def written():
        if path.exists():
            seen.add(path.stat().st_mtime_ns)
        return len(seen) == 2

    assert wait_for(written, process), process.communicate()
    process.kill()
    process.communicate()
    train(KILLED, folder, Session(save_every=0.05))
    train(KILLED, tmp_path / "undisturbed")
    assert_same_run(tmp_path / "undisturbed", folder)


def test_a_run_that_is_asked_to_stop_writes_a_checkpoint_and_resumes_from_there(short, tmp_path):
    steps = []

    def watch(history, step):
        steps.append(step)

    with pytest.raises(StoppedError, match="stopped after 40 steps"):
        train(SHORT, tmp_path, Session(watch, stop=lambda: steps[-1] == 40))
    assert not (tmp_path / "run.json").exists()
    assert steps[0] == 0
    train(SHORT, tmp_path, Session(watch))
    assert steps == sorted(steps)
    assert steps.count(40) == 2  # where it stopped, and where it resumed
    assert_same_run(short, tmp_path)


def made_up(*means):
    """What is recorded of a run whose evaluations had these mean returns."""
    history = History()
    for number, mean in enumerate(means):
        history.add(1000 * number, Outcome(np.array([mean - 1, mean + 1]), [{}, {}]))
    return history


class Terminal(io.StringIO):
    """A terminal with Unicode or without."""

    def __init__(self, encoding):
        super().__init__()
        self._encoding = encoding

    encoding = property(lambda self: self._encoding)

    def isatty(self):
        return True


def test_a_terminal_shows_the_last_return(monkeypatch):
    terminal = Terminal("utf-8")
    monkeypatch.setattr(sys, "stderr", terminal)
    with closing(Bar(5_000_000, "sac on a-long-name-of-an-encoder")) as bar:
        bar.show(made_up(), 1000)
        bar._progress.start_t -= 36_000  # seconds
        bar.show(made_up(-20.0, 50.0), 100_000)
        bar._progress.refresh()
        line = terminal.getvalue().split("\r")[-1].rstrip()
        assert len(line) < 80
        assert line.startswith("sac on a-long...: 100k/5.00M, 2.75/s, ")
        assert line.endswith(" left, returns=50.0")


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # of infinite returns
@pytest.mark.parametrize("algorithm", ["ddpg", "ppo"])
def test_a_run_that_diverges_is_marked_failed(algorithm, tmp_path, monkeypatch):
    preset = get_preset("paper", algorithm)
    kwargs = {**preset.algorithm_kwargs, "learning_rate": 1e30}
    wild = preset.replace(algorithm_kwargs=kwargs)
    monkeypatch.setitem(ALGORITHMS[algorithm].presets, "paper", wild)
    run = Run.of(algorithm=algorithm, steps=4096, **QUICK, preset="paper")
    result = train(run, tmp_path / "wild")
    assert result.status == FAILED
    assert "loss is" in result.reason or "not finite" in result.reason
    assert result.steps < 4096 + 2048
    assert not (tmp_path / "wild" / "policy.zip").exists()
    assert train(run, tmp_path / "wild") == result
    with pytest.raises(InputError, match="failed: it has no policy"):
        load_run(tmp_path / "wild")


class Trap:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_in_a_runs_folder_runs_as_code(short, tmp_path):
    """Neither is policy.zip read, nor a pickle in the place of the policy's file."""
    folder, sprung = shutil.copytree(short, tmp_path / "run"), tmp_path / "sprung"
    trap = pickle.dumps(Trap(sprung), protocol=2)
    with zipfile.ZipFile(folder / "policy.zip", "w") as file:
        file.writestr("policy.pth", trap)
        file.writestr("data", trap)
    assert load_run(folder).task == TASK
    (folder / POLICY).write_bytes(trap)
    record = json.loads((folder / "run.json").read_text())
    record["policy_sha256"] = hashlib.sha256(trap).hexdigest()
    forge(folder / "run.json", record)
    with pytest.raises(InputError, match="is not a jbrep policy"):
        load_run(folder)
    assert not sprung.exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (POLICY, r"can't read .*policy\.safetensors: No such file"),
        ("encoder.safetensors", "no encoder"),
        ("run.json", "no run in"),
    ],
)
def test_a_folder_without_one_of_its_files_is_named(name, message, short, tmp_path):
    folder = shutil.copytree(short, tmp_path / "run")
    (folder / name).unlink()
    with pytest.raises(InputError, match=message) as error:
        load_run(folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"task": "fly"}, "task"),
        ({"algorithm": "dqn"}, "algorithm"),
        ({"preset": "wide"}, "preset"),
        ({"encoder": "dae-9"}, "encoder"),
        ({"steps": 10**23}, "steps"),
        ({"evaluation_episodes": 3, "final_episodes": 2}, "final_episodes"),
    ],
)
def test_what_cannot_be_run_is_refused(change, named, tmp_path):
    usual = {"algorithm": "a2c", "encoder": "dae-8", "steps": 80, **QUICK}
    with pytest.raises(InputError, match=named):
        train(Run.of(**{**usual, **change}), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_evaluations_take_a_small_share_of_a_run_with_the_defaults():
    """At most 15 % of its steps; and short runs aren't evaluated all the time."""
    run = Run.of(task="face_direction", preset="wide")
    settings = run.settings(run.find_encoder())
    assert (settings.evaluate_every, settings.final_episodes) == (100_000, 50)
    used = settings.hyperparameters
    steps = range(0, settings.steps, used.num_envs * used.action_repeat)
    times = sum(map(settings.is_evaluation_due, steps))
    assert times == 10
    episodes = times * settings.evaluation_episodes + settings.final_episodes
    assert episodes * run.task.max_episode_steps <= 0.15 * settings.steps
    short = run.replace(steps=50_000)
    assert short.settings(short.find_encoder()).evaluate_every == 10_000


LENGTH = 1000


def episodes(beta, sigma, envs):
    """What environments draw in their first episode, (environments, steps)."""
    np.random.seed(0)  # noqa: NPY002 - stable-baselines3 draws there
    each = [ColouredActionNoise(beta, sigma, 1, LENGTH) for _ in range(envs)]
    return np.array([[float(one()[0]) for _ in range(LENGTH)] for one in each])


@pytest.mark.parametrize("beta", [0.5, 2.0])
def test_coloured_noise_has_its_spectrum_and_spread(beta):
    drawn = episodes(beta, 0.3, 64)
    power = (np.abs(np.fft.rfft(drawn)) ** 2).mean(0)
    frequency = np.fft.rfftfreq(LENGTH)
    slope, _ = np.polyfit(np.log(frequency[1:-1]), np.log(power[1:-1]), 1)
    assert slope == pytest.approx(-beta, abs=0.05)
    assert np.sqrt((drawn**2).mean()) == pytest.approx(0.3, rel=0.2)


def test_noise_of_the_next_episode_is_drawn_when_the_last_is_over_or_cut_short():
    np.random.seed(0)  # noqa: NPY002
    whole = [ColouredActionNoise(1, 0.2, 2, 4) for _ in range(3)]
    firsts = [each() for each in whole]
    np.random.seed(0)  # noqa: NPY002
    noise = ColouredActionNoise(1, 0.2, 2, 4)
    first, *_, fifth = [noise() for _ in range(5)]
    noise.reset()
    for drawn, expected in zip((first, fifth, noise()), firsts, strict=True):
        np.testing.assert_array_equal(drawn, expected)


def test_an_episode_of_one_step_has_noise():
    assert np.isfinite(ColouredActionNoise(1, 0.2, 3, 1)()).all()
