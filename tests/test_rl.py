"""One run: settings, files, evaluation, kills and stops, failures, and files from elsewhere."""

import hashlib
import io
import json
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from small import assert_same_files, forge
from stable_baselines3 import SAC
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecMonitor

from jbrep.encoders import find
from jbrep.envs import Lanes, describe
from jbrep.envs.recording import Outcome, episode_returns
from jbrep.errors import InputError
from jbrep.records import container
from jbrep.rl import Run, Session, StoppedError, train
from jbrep.rl.agent import Evaluator, make_agent, make_env, training_seed
from jbrep.rl.bar import Bar
from jbrep.rl.files import EVALUATION_SEED, FAILED, FINISHED, POLICY, read_evaluations, read_run
from jbrep.rl.from_zip import load_zip
from jbrep.rl.history import History
from jbrep.rl.policy import load_run
from jbrep.rl.presets import PRESETS, get_preset, sb3_class

STEPS = 100  # of an episode: little depends on its length
TASK = describe("face_direction", max_episode_steps=STEPS)
QUICK = {"task": TASK, "evaluation_episodes": 1, "final_episodes": 2}
# to evaluate the text of a run
IMPORTS = "from msgspec import UNSET; from jbrep.envs import Feature, Task; "
IMPORTS += "from jbrep.rl.learner import Learner"
SHORT = Run.of(algorithm="a2c", encoder="dae-8", steps=80, **QUICK, preset="paper")


def agent_of(algorithm, preset="paper", encoder="dae-8"):
    settings = get_preset(preset, algorithm)
    env = make_env(TASK, settings.num_envs, 0, find(encoder, TASK))
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
    ("preset", "rate", "every", "gradient_steps", "batch", "starts", "units", "robots"),
    [("modern", 3e-4, 4, 1, 256, 1000, 256, 1), ("wide", 1e-3, 1, 8, 512, 12_800, 128, 64)],
)
def test_the_usual_settings_reach_sac(
    preset, rate, every, gradient_steps, batch, starts, units, robots
):
    sac = agent_of("sac", preset)
    assert (sac.lr_schedule(1), sac.gamma, sac.ent_coef) == (rate, 0.99, "auto")
    assert (sac.train_freq.frequency, sac.gradient_steps) == (every, gradient_steps)
    assert (sac.batch_size, sac.learning_starts, sac.n_envs) == (batch, starts, robots)
    assert (sac.replay_buffer.buffer_size * robots, sac.action_noise) == (1_000_000, None)
    assert widths(sac.critic) == [units, units, 1] * 2
    assert get_preset(preset, "sac").action_repeat == (2 if preset == "wide" else 1)


def test_the_later_versions_settings_reach_sac_and_td3():
    sac, td3 = agent_of("sac"), agent_of("td3")
    for agent in (sac, td3):
        assert agent.lr_schedule(1) == 1e-4
        assert isinstance(agent.action_noise, NormalActionNoise)
        assert (agent.action_noise._mu, agent.action_noise._sigma) == (0, 0.2)
        assert widths(agent.actor)[:2] == [350, 250]
    assert (sac.batch_size, sac.ent_coef) == (256, "auto")
    assert (td3.learning_starts, td3.gradient_steps) == (10_000, 1000)
    assert td3.train_freq.frequency == 1000


@pytest.mark.parametrize(
    ("algorithm", "preset"),
    [(algorithm, name) for name, its in PRESETS.items() for algorithm in its],
)
def test_every_preset_makes_an_agent_with_adam(algorithm, preset):
    agent = agent_of(algorithm, preset)
    optimizers = [
        m.optimizer for m in (agent.policy, *agent.policy.children()) if hasattr(m, "optimizer")
    ]
    assert optimizers
    assert {type(o) for o in optimizers} == {torch.optim.Adam}
    assert agent.predict(agent.env.reset())[0].shape == (PRESETS[preset][algorithm].num_envs, 1)


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
    assert (short / "episodes.csv").read_text() == "step,lane,return,length,diverged\n"
    assert list((short / "tensorboard").glob("events.*"))
    assert not (short / "checkpoint.safetensors").exists()


def test_plain_sb3_loads_the_policy_that_was_evaluated(short):
    plain = sb3_class("a2c").load(short / "policy.zip", device="cpu")
    trained = load_run(short)
    encoder = find("dae-8", TASK)
    rows = encoder(np.random.default_rng(0).normal(size=(50, 16)).astype(np.float32))
    expected = plain.predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(trained.policy.predict(rows, deterministic=True)[0], expected)
    returns = episode_returns(Lanes(TASK, 1), trained.begin(TASK, [0]), EVALUATION_SEED)
    at_end = [e.episode_return for e in read_evaluations(short) if e.step == 80]
    np.testing.assert_allclose(returns, at_end[:1], atol=5e-4)


def test_evaluation_is_the_deterministic_policys_return():
    agent = agent_of("ppo")
    encoder = find("dae-8", TASK)
    lanes, total = Lanes(TASK, 2), np.zeros(2)
    lanes.reset([0, 1], [EVALUATION_SEED, EVALUATION_SEED + 1])
    for _ in range(STEPS):
        latent = encoder(lanes.observation.astype(np.float32))
        total += lanes.step(agent.predict(latent, deterministic=True)[0]).reward
    evaluator = Evaluator(Lanes(TASK, 2), encoder, 2)
    for _ in range(2):  # the same episodes each time
        np.testing.assert_allclose(evaluator.outcome(agent).returns, total, rtol=1e-5)


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
        ("800", str(lane), f"{STEPS}", "0") for lane in range(8)
    ]
    assert len({row[2] for row in rows}) > 4


def test_runs_of_two_seeds_share_no_start_with_each_other_or_evaluation():
    seeds = [training_seed(seed) for seed in range(1000)]
    assert min(np.diff(sorted(seeds))) > 64
    assert max(seeds) + 64 < EVALUATION_SEED


def test_training_starts_from_these_seeds_whatever_the_agent_seeds(tmp_path, monkeypatch):
    reset, starts = VecMonitor.reset, []
    monkeypatch.setattr(VecMonitor, "reset", lambda env: starts.append(reset(env)) or starts[-1])
    train(SHORT.replace(seed=3), tmp_path / "run")
    expected = make_env(TASK, 8, training_seed(3), find("dae-8", TASK)).venv.reset()
    assert [np.array_equal(start, expected) for start in starts if len(start) == 8] == [True]


def test_the_full_observation_is_scaled_as_encoders_scale_it():
    full, dae = find("full", TASK), find("dae-8", TASK)
    env = make_env(TASK, 1, 7, full)
    plain = Lanes(TASK, 1).reset([0], [7]).astype(np.float32)
    np.testing.assert_allclose(env.reset(), dae.scaler.scale(plain), rtol=1e-5, atol=1e-6)


def test_neither_threads_nor_clock_nor_process_change_a_bit(short, tmp_path):
    text = (
        "import time, torch; from pathlib import Path; from jbrep.rl import Run, Session, train\n"
        f"{IMPORTS}\n"
        "torch.set_num_threads(2)\n"
        "for seconds in (0, 1 << 33):\n"  # zip files can't be dated before 1980 or after 2107
        "    time.time = lambda: seconds\n"
        f"    train({SHORT!r}, Path({str(tmp_path)!r}, str(seconds)))"
    )
    subprocess.run([sys.executable, "-c", text], check=True)
    for seconds in (0, 1 << 33):
        assert_same_run(short, tmp_path / str(seconds))


def test_another_seed_is_another_run(short, tmp_path):
    train(SHORT.replace(seed=1), tmp_path / "other")
    with pytest.raises(AssertionError):
        assert_same_run(short, tmp_path / "other")


def test_a_finished_run_is_left_alone(short):
    before = {p: p.stat().st_mtime_ns for p in short.iterdir()}
    assert train(SHORT, short).status == FINISHED
    with pytest.raises(InputError, match=r"holds another run: seed 0 \(now: 5\)"):
        train(SHORT.replace(seed=5), short)
    assert {p: p.stat().st_mtime_ns for p in short.iterdir()} == before


def test_a_run_that_another_process_has_just_finished_is_left_alone(short, tmp_path, monkeypatch):
    folder = tmp_path / "run"

    @contextmanager
    def wait_for_another_process(_):
        shutil.copytree(short, folder, dirs_exist_ok=True)
        yield

    monkeypatch.setattr("jbrep.rl.training.exclusive", wait_for_another_process)
    monkeypatch.setattr("jbrep.rl.training.save", lambda *_: pytest.fail("it was trained again"))
    assert train(SHORT, folder) == read_run(short)


KILLED = {
    "ddpg": Run.of(algorithm="ddpg", encoder="dae-8", steps=300, **QUICK, preset="paper"),
    "sac": Run.of(
        task="Hopper-v5", preset="modern", steps=1100, evaluation_episodes=1, final_episodes=1
    ),
}


def kill(run, folder, checkpoints=2):
    """Train in another process; kill it when so many checkpoints have been written."""
    text = (
        f"from pathlib import Path; from jbrep.rl import Run, Session, train; {IMPORTS};"
        f"train({run!r}, Path({str(folder)!r}), Session(save_every=0.05))"
    )
    process = subprocess.Popen([sys.executable, "-c", text], stderr=subprocess.PIPE, text=True)
    seen, path = set(), folder / "checkpoint.safetensors"
    while process.poll() is None and len(seen) < checkpoints:
        if path.exists():
            seen.add(path.stat().st_mtime_ns)
        time.sleep(0.005)
    process.kill()
    error = process.communicate()[1]
    return process.returncode, error[-2000:]


@pytest.mark.parametrize("algorithm", KILLED)
def test_a_killed_run_resumes_to_the_same_bits(algorithm, tmp_path):
    run, folder = KILLED[algorithm], tmp_path / "killed"
    killed, error = kill(run, folder)
    assert killed == -signal.SIGKILL, error
    written = (folder / "checkpoint.safetensors").read_bytes()
    train(run, folder, Session(save_every=0.05))
    train(run, tmp_path / "undisturbed")
    assert_same_run(tmp_path / "undisturbed", folder)
    (tmp_path / "spoilt").mkdir()
    spoilt = tmp_path / "spoilt" / "checkpoint.safetensors"
    for content in (written[:-100], b"", pickle.dumps(run), written):
        spoilt.write_bytes(content)
        with pytest.raises(InputError, match=r"checkpoint\.safetensors is|holds another run: seed"):
            train(run.replace(seed=9), tmp_path / "spoilt")
    assert [p.name for p in spoilt.parent.iterdir() if p.suffix] == [spoilt.name]


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


def test_ctrl_c_stops_the_command_with_a_checkpoint(tmp_path):
    settings = ("--task", TASK.name, "--episode-steps", STEPS, "--evaluation-episodes", 1)
    settings += ("--steps", "1M", "--out", tmp_path)
    command = [sys.executable, "-c", "from jbrep.cli import main; main()", "rl"]
    process = subprocess.Popen(
        [*command, *map(str, settings)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    while process.poll() is None and not (tmp_path / "tensorboard").exists():
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    lines = process.communicate(timeout=120)[1].splitlines()
    assert process.returncode == 128 + signal.SIGINT, lines
    assert any(line.startswith("stopping: writing a checkpoint") for line in lines)
    told = re.fullmatch(r"stopped after ([\d,]+) steps; the same command resumes it", lines[-1])
    header = container.read(tmp_path / "checkpoint.safetensors", "checkpoint")[1]
    assert header["step"] == int(told[1].replace(",", ""))


def test_a_second_signal_ends_the_command_at_once():
    text = (
        "import os, signal, time; from jbrep.cli.signals import stop_signals\n"
        "with stop_signals() as received:\n"
        "    os.kill(os.getpid(), signal.SIGTERM); print(len(received), flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGINT); time.sleep(60)"
    )
    process = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert process.returncode == -signal.SIGINT
    assert process.stdout == "1\n"
    assert "Ctrl-C again ends at once" in process.stderr


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


@pytest.mark.parametrize(
    ("encoding", "means", "course"),
    [
        ("utf-8", [], "-"),
        ("utf-8", [50.0], "▁ 50.0"),
        ("utf-8", [-20.0, 50.0, 85.0, 120.0, 50.0], "▁▅▆█▅ 50.0"),
        ("utf-8", [*range(100), 10_000.0], "▁▁▁▁▁▁▁▁▂█ 10,000"),
        ("ascii", [0.0, 50.0], "50.0"),
    ],
)
def test_a_terminal_shows_the_course_of_the_return(encoding, means, course, monkeypatch):
    terminal = Terminal(encoding)
    monkeypatch.setattr(sys, "stderr", terminal)
    with closing(Bar(5_000_000, "sac on a-long-name-of-an-encoder")) as bar:
        bar.show(made_up(), 1000)
        bar._progress.start_t -= 36_000  # seconds
        bar.show(made_up(*means), 100_000)
        bar._progress.refresh()
        line = terminal.getvalue().split("\r")[-1].rstrip()
        assert len(line) < 80
        assert line.startswith("sac on a-long...: 100k/5.00M, 2.75/s, ")
        assert line.endswith(f" left, returns={course}")


def test_the_rate_after_resuming_counts_the_steps_since():
    history = made_up()
    with closing(Bar(1000, "sac")) as bar:
        bar.show(history, 500)
        bar.show(history, 600)
        assert (bar._progress.n, bar._progress.initial) == (600, 500)
        bar.show(history, 1008)
        assert (bar._progress.n, bar._progress.postfix) == (1000, "returns=final ones under way")
        history.add(1000, Outcome(np.array([1.5, 2.5]), [{}, {}]))
        bar.show(history, 1008)
        assert bar._progress.postfix == "returns=2.00"


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # of infinite returns
@pytest.mark.parametrize("algorithm", ["ddpg", "sac", "ppo", "a2c", "trpo"])
def test_a_run_that_diverges_is_marked_failed(algorithm, tmp_path, monkeypatch):
    preset = get_preset("paper", algorithm)
    kwargs = {**preset.algorithm_kwargs, "learning_rate": 1e30}
    wild = preset.replace(algorithm_kwargs=kwargs)
    monkeypatch.setitem(PRESETS["paper"], algorithm, wild)
    run = Run.of(algorithm=algorithm, steps=4096, **QUICK, preset="paper")
    result = train(run, tmp_path / "wild")
    assert result.status == FAILED
    assert "loss is" in result.reason or "not finite" in result.reason
    assert result.steps < 4096 + 2048
    assert not (tmp_path / "wild" / "policy.zip").exists()
    assert train(run, tmp_path / "wild") == result
    with pytest.raises(InputError, match="failed: it has no policy"):
        load_run(tmp_path / "wild")


def test_a_run_tells_all_its_steps_before_its_last_evaluation(tmp_path):
    told = []
    run = Run.of(algorithm="ddpg", steps=1200, evaluate_every=600, **QUICK, preset="paper")
    session = Session(lambda history, step: told.append((step, [0, *history.means][-1])))
    train(run, tmp_path / "run", session)
    evaluations = read_evaluations(tmp_path / "run")
    means = [np.mean([e.episode_return for e in evaluations if e.step == s]) for s in (600, 1200)]
    assert means[0] != means[1]
    assert told[-2:] == [(1200, pytest.approx(means[0])), (1200, pytest.approx(means[1]))]


def test_an_error_whose_words_sound_like_divergence_is_not_taken_for_it(tmp_path):
    def watch(history, step):
        raise ValueError("found invalid values: actions are not finite")

    with pytest.raises(ValueError, match="found invalid values"):
        train(SHORT, tmp_path, Session(watch))
    assert not (tmp_path / "run.json").exists()


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


def test_a_zip_file_from_elsewhere_needs_trust(tmp_path):
    path = tmp_path / "agent.zip"
    SAC("MlpPolicy", make_env(TASK, 1, 0, find("dae-8", TASK)), buffer_size=10).save(path)
    with pytest.raises(InputError, match="runs as code when it is read; add --trust"):
        load_zip(path, TASK, "sac", "dae-8", trust=False)
    assert load_zip(path, TASK, "sac", "dae-8", trust=True).trained.task == TASK
    for algorithm, encoder in (("sac", "dae-4"), ("ppo", "dae-8"), ("fly", "dae-8")):
        with pytest.raises(InputError, match=r"isn't a|unknown algorithm|observes 8 numbers"):
            load_zip(path, TASK, algorithm, encoder, trust=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": "fly"}, "unknown task"),
        ({"algorithm": "dqn"}, "unknown algorithm 'dqn': choose one of ddpg"),
        ({"preset": "best"}, "unknown preset 'best': choose one of paper, modern, wide"),
        (
            {"preset": "wide"},
            "preset wide is for ddpg, td3, sac, tqc, crossq, not a2c: choose one of paper, modern",
        ),
        ({"encoder": "dae-9"}, "no encoder 'dae-9'"),
        ({"seed": 2**31}, "seed is 2147483648"),
        ({"steps": 0}, "steps is 0"),
        ({"steps": 10**23}, f"steps is {10**23}: it must be"),
        ({"evaluate_every": -1}, "evaluate_every is -1"),
        ({"evaluation_episodes": 10_001}, "evaluation_episodes is 10001"),
        ({"evaluation_episodes": 3, "final_episodes": 2}, "final_episodes is 2: .* as many as"),
    ],
)
def test_what_cannot_be_run_is_refused(change, message, tmp_path):
    usual = {"algorithm": "a2c", "encoder": "dae-8", "steps": 80, **QUICK}
    with pytest.raises(InputError, match=message):
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
