"""A run's folder read back: damaged, forged, under way; whatever comes, one line or a policy."""

import bz2
import functools
import hashlib
import io
import json
import operator
import os
import pickle
import shutil
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from command import jbrep
from stable_baselines3 import A2C
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jbrep.encoders import find, save
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.play.sources import find_player
from jbrep.records import container
from jbrep.records.record import to_plain
from jbrep.rl import Run, train
from jbrep.rl.agent import make_env
from jbrep.rl.files import (
    CHECKPOINT,
    ENCODER,
    EVALUATIONS,
    POLICY,
    POLICY_FORMAT,
    RUN,
    is_policy_file,
    read_evaluations,
    read_run,
)
from jbrep.rl.history import Scalars
from jbrep.rl.policy import load_run, load_untrained, load_zip
from jbrep.study.results import read_results, write_results

TASK = describe("face_direction")
SETTINGS = Run(task=TASK, algorithm="a2c", encoder="dae-8", steps=80, evaluation_episodes=1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run, and beside it the checkpoint that it had after 40 steps."""
    folder = tmp_path_factory.mktemp("runs") / "a2c"
    write = container.write

    def keep(path, tensors, header):
        write(path, tensors, header)
        if path.name == CHECKPOINT and header["counters"]["num_timesteps"] == 40:
            shutil.copy(path, folder.parent)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(container, "write", keep)
        train(SETTINGS, folder, save_every=0)
    return folder


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run to spoil."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture
def under_way(trained, tmp_path):
    """The same run as it was when its checkpoint was written."""
    folder = tmp_path / "under-way"
    folder.mkdir()
    shutil.copy(trained / ENCODER, folder)
    shutil.copy(trained.with_name(CHECKPOINT), folder)
    return folder


def refused(use, *arguments):
    """The one line that a user gets."""
    with pytest.raises(InputError) as error:
        use(*arguments)
    assert "\n" not in str(error.value)
    return str(error.value)


def forge(folder, policy):
    """Give a run another policy.zip, with the hash that belongs to it."""
    (folder / POLICY).write_bytes(policy)
    change(folder, policy_sha256=hashlib.sha256(policy).hexdigest())


def change(folder, **changes):
    record = json.loads((folder / RUN).read_text())
    (folder / RUN).write_text(json.dumps({**record, **changes}))


def shorten(folder, episode_steps=30, **others):
    settings = json.loads((folder / RUN).read_text())["settings"]
    environment = {**settings["environment"], "max_episode_steps": episode_steps}
    change(folder, settings={**settings, "environment": environment, **others})


def policy_zip(weights, compression=zipfile.ZIP_STORED):
    """A policy's file with these weights, pickled by torch, or these bytes."""
    if not isinstance(weights, bytes):
        content = io.BytesIO()
        torch.save(weights, content)
        weights = content.getvalue()
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        archive.writestr("policy.pth", weights)
    return file.getvalue()


def weights_of(folder):
    with zipfile.ZipFile(folder / POLICY) as archive:
        return torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True)


ODD = (
    *(None, True, -1, 0, 1.5, 10**30, float("nan"), float("inf"), "", "x", "x" * 2000, "\x1b[2J"),
    *("\ud800", "../../up", [], [[]], [10**9], ["x"], {}, {"x": 10**30}, {"x": float("nan")}),
)


def mutations(record):
    """The record with each field, of settings and environment too, missing or of odd values."""
    settings = record["settings"]
    paths = [(name,) for name in record] + [("settings", name) for name in settings]
    for path in paths + [("settings", "environment", name) for name in settings["environment"]]:
        for value in (..., *ODD):
            mutant = json.loads(json.dumps(record))
            parent = functools.reduce(operator.getitem, path[:-1], mutant)
            if value is ...:
                del parent[path[-1]]
            else:
                parent[path[-1]] = value
            yield mutant


def attempt(use, folder):
    """What it gives; None if it refuses, in one line."""
    try:
        return use(folder)
    except InputError as error:
        message = str(error)
    assert message.isprintable()
    return None


def test_every_field_of_a_run_is_checked(run):
    """Whatever run.json says, it is refused in one line, or can be used by all who read it."""
    record = json.loads((run / RUN).read_text())
    known = {None, json.dumps(read_run(run))}
    for mutant in mutations(record):
        (run / RUN).write_text(json.dumps(mutant))
        content = attempt(read_run, run)
        text = content and json.dumps(content, allow_nan=False)
        if text not in known:
            known.add(text)
            attempt(load_run, run)
            attempt(lambda folder: write_results(read_results(folder), folder), run)
    assert 20 < len(known) < 100  # most are refused


def test_a_damaged_byte_of_a_run_is_refused_or_harmless(run):
    whole, random = (run / RUN).read_bytes(), np.random.default_rng(0)
    for trial in range(300):
        content = bytearray(whole)
        place = random.integers(len(content))
        content[place] = random.integers(256)
        (run / RUN).write_bytes(content if trial % 3 else content[:place])
        attempt(read_run, run)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "JSON object"),
        (b"[]", "JSON object"),
        (b"[" * 100_000, "JSON object"),
        (b'"x"', "JSON object"),
        (b"\xff\xfe", "JSON object"),
        (b"{}", "status is missing, it must be finished or failed"),
        (b'{"seconds": NaN}', "JSON object of finite numbers"),
        (b'{"format": "jbrep study"}', "its format is another"),
        (b'{"format_version": 7}', "has format version 7: this jbrep reads up to 2"),
    ],
)
def test_a_run_file_of_anything_else(content, message, run):
    (run / RUN).write_bytes(content)
    assert message in refused(read_run, run)
    for command in (("evaluate-policy", run), ("report", run), ("inspect", run)):
        told = jbrep(*command)
        assert (told.exit_code, told.output.count("\n")) == (2, 1)


def test_a_run_of_an_earlier_version_is_read(run):
    record = json.loads((run / RUN).read_text())
    for name in ("format", "format_version"):
        del record[name]
    for name in ("environment", "from"):
        del record["settings"][name]
    (run / RUN).write_text(json.dumps(record))
    assert read_run(run)["settings"]["environment"]["max_episode_steps"] == 1000
    assert load_run(run).task == TASK


@pytest.mark.parametrize(
    "rows",
    [
        "",
        "0,0",
        "0,0,1,2",
        "0,0,nan",
        "0,0,inf",
        f"{10**30},0,1",
        "-1,0,1",
        f"0,{10**8},1",
        "0,1,1",
        "0,0,1\n0,1,1\n80,0,1",
        "0,0,1\n40,0,1\n40,1,1\n80,0,1",
        "80,0,1\n0,0,1",
        "0,0,1\n0,0,1",
        "0,0,1\n" + "9" * 200_000,
        '0,0,"1',
        "\0",
    ],
    ids=range(16),
)
def test_evaluations_that_are_none(rows, run):
    header = "step,episode,return\n" if rows else ""
    (run / EVALUATIONS).write_text(header + rows)
    assert "not a table of evaluations" in refused(read_evaluations, run)
    told = jbrep("report", run)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)


def test_weights_are_those_of_the_run(run):
    forged = policy_zip({name: value + 1 for name, value in weights_of(run).items()})
    (run / POLICY).write_bytes(forged)
    assert "its SHA-256 isn't in run.json" in refused(load_run, run)
    change(run, policy_sha256=None)
    assert "policy_sha256 is invalid" in refused(load_run, run)


def bits(content):
    return content[:-30] + bytes(byte ^ 1 for byte in content[-30:])


def without(weights, name):
    return {key: value for key, value in weights.items() if key != name}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda weights: policy_zip({}), "doesn't fit the run's settings"),
        (lambda weights: policy_zip(without(weights, "action_net.bias")), "doesn't fit"),
        (lambda weights: policy_zip({**weights, "more": torch.ones(1)}), "doesn't fit"),
        (lambda weights: policy_zip({**weights, "log_std": torch.ones(3)}), "doesn't fit"),
        (lambda weights: policy_zip({**weights, "log_std": "x"}), "doesn't fit"),
        (lambda weights: policy_zip([1, 2]), "holds no policy's weights"),
        (
            lambda weights: policy_zip({**weights, "log_std": torch.full((1,), torch.nan)}),
            "weights are not finite",
        ),
        (lambda weights: policy_zip(weights, zipfile.ZIP_DEFLATED), "is compressed"),
        (lambda weights: policy_zip(weights, zipfile.ZIP_LZMA), "is compressed"),
        (lambda weights: policy_zip(bz2.compress(bytes(1000))), "holds no policy's weights"),
        (lambda weights: bits(policy_zip(weights)), "holds no policy's weights"),
        (lambda weights: policy_zip(weights)[:-40], "holds no policy's weights"),
        (lambda weights: b"PK", "holds no policy's weights"),
        (lambda weights: pickle.dumps(weights), "holds no policy's weights"),
    ],
    ids=range(14),
)
def test_a_policy_that_isn_t_the_run_s(make, message, run):
    """Its hash is right: a stranger can work it out."""
    forge(run, make(weights_of(run)))
    assert message in refused(load_run, run)


class Bytes:
    """Unpickled, this many bytes: 2^35 of them in 30."""

    def __reduce__(self):
        return bytearray, (1 << 35,)


def test_a_small_policy_stays_small(run):
    forge(run, policy_zip({"log_std": Bytes()}))
    assert "it names '__builtin__ bytearray'" in refused(load_run, run)


def test_weights_too_large_to_act_with_are_refused(run):
    shorten(run)
    signs = {name: torch.sign(value - 0.01) for name, value in weights_of(run).items()}
    forge(run, policy_zip({name: 1e38 * sign for name, sign in signs.items()}))
    told = jbrep("evaluate-policy", run, "--episodes", 1)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    assert "the policy's actions are not finite" in told.output


@pytest.mark.parametrize("name", [RUN, POLICY, ENCODER, EVALUATIONS])
def test_files_that_are_not_regular_are_not_opened(name, run):
    """A pipe that nobody fills would hang, a link to /dev/zero would never end."""
    path = run / name
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir):
        path.unlink()
        make(path)
        errors = []
        use = read_evaluations if name == EVALUATIONS else load_run
        thread = threading.Thread(target=lambda: errors.append(refused(use, run)), daemon=True)  # noqa: B023
        thread.start()
        thread.join(timeout=30)
        assert name in errors[0]
        if path.is_dir():
            path.rmdir()
            path.touch()


def test_a_file_from_elsewhere_must_be_a_regular_one(tmp_path):
    path = tmp_path / "agent.zip"
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(path)
        assert "must be a regular file" in refused(load_zip, path, TASK, "a2c", "dae-8", True)
        path.unlink()
    A2C("MlpPolicy", make_env(TASK, 1, 0, find("dae-8", TASK))).save(tmp_path / "real.zip")
    path.symlink_to(tmp_path / "real.zip")
    assert load_zip(path, TASK, "a2c", "dae-8", trust=True).task == TASK


def test_a_run_under_way_plays_its_checkpoint(under_way, trained):
    playing = load_run(under_way)
    assert playing.step == 40
    final, first = weights_of(trained), load_untrained(under_way).policy.state_dict()
    now = playing.policy.state_dict()
    assert {*now} == {*final}
    weight = "action_net.weight"
    assert not torch.equal(now[weight], final[weight])
    assert not torch.equal(now[weight], first[weight])
    player = find_player(str(under_way))
    assert (player.name, player.step) == (f"{under_way} at step 40", 40)
    told = jbrep("evaluate-policy", under_way, "--episodes", 1).output
    assert told.startswith(f"{TASK.name} on dae-8 at step 40: median return ")


def test_a_checkpoint_s_policy_is_the_agent_s_at_that_step(trained, tmp_path):
    """A run that ends where the other's checkpoint was written has the same policy."""
    train(Run(**{**vars(SETTINGS), "steps": 40}), tmp_path)
    ours = container.read(trained.with_name(CHECKPOINT), "checkpoint", 1 << 30)[0]
    for name, value in weights_of(tmp_path).items():
        np.testing.assert_array_equal(ours[f"parameters.policy.{name}"], value)


@pytest.mark.parametrize("algorithm", ["ddpg", "sac", "td3", "ppo", "trpo"])
def test_the_checkpoint_of_every_algorithm_is_played(algorithm, tmp_path):
    from jbrep.rl.agent import make_agent
    from jbrep.rl.presets import Preset, get_preset

    encoder, run = find("dae-8", TASK), Run(task=TASK, algorithm=algorithm, encoder="dae-8")
    preset = Preset(get_preset("paper", algorithm).hidden, {})
    agent = make_agent(algorithm, preset, make_env(TASK, 1, 0, encoder), seed=3)
    agent.env.reset()
    tensors = {
        f"parameters.policy.{name}": np.ascontiguousarray(value.numpy())
        for name, value in agent.policy.state_dict().items()
    }
    header = {"identity": run.describe(encoder), "counters": {"num_timesteps": 7}, "record": {}}
    container.write(tmp_path / CHECKPOINT, tensors, header)
    save(encoder, tmp_path / ENCODER)
    playing = load_run(tmp_path)
    seen = np.random.default_rng(0).uniform(-1, 1, (5, 8)).astype(np.float32)
    np.testing.assert_array_equal(
        playing.policy.predict(seen, deterministic=True)[0],
        agent.predict(seen, deterministic=True)[0],
    )


def spoilt(header):
    for name in ("identity", "counters"):
        for value in (None, [], {}):
            yield {**header, name: value}
    for name in ("task", "hidden", "seed", "evaluation_episodes"):
        yield {**header, "identity": {**header["identity"], name: 10**30}}
    for value in (-1, 1.5, "x"):
        yield {**header, "counters": {**header["counters"], "num_timesteps": value}}


def test_a_damaged_checkpoint_is_named(under_way):
    path = under_way / CHECKPOINT
    tensors, header = container.read(path, "checkpoint", 1 << 30)
    for changed in spoilt(header):
        container.write(path, tensors, changed)
        assert CHECKPOINT in refused(load_run, under_way)
    container.write(path, without(tensors, "parameters.policy.log_std"), header)
    assert "doesn't fit the run's settings" in refused(load_run, under_way)
    nan = {**tensors, "parameters.policy.log_std": np.full(1, np.nan, np.float32)}
    container.write(path, nan, header)
    assert "not finite" in refused(load_run, under_way)
    path.write_bytes(path.read_bytes()[:100])
    assert CHECKPOINT in refused(load_run, under_way)


def test_a_run_without_a_checkpoint_so_far(under_way):
    (under_way / CHECKPOINT).unlink()
    assert f"{RUN} or {CHECKPOINT} is expected" in refused(load_run, under_way)
    told = jbrep("evaluate-policy", under_way)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    assert "no run with a policy or checkpoint" in told.output


def test_evaluating_a_run(run):
    shorten(run)
    by_folder = jbrep("evaluate-policy", run, "--episodes", 2).output
    assert by_folder.endswith("(10-90 % of 2 episodes)\n")
    assert len(by_folder.rstrip()) <= 80
    assert jbrep("evaluate-policy", run / POLICY, "--episodes", 2).output == by_folder
    record = json.loads(jbrep("evaluate-policy", run, "--episodes", 2, "--json").output)
    assert (record["task"], record["representation"]) == (TASK.name, "dae-8")
    assert record["median"] == pytest.approx(np.median(record["returns"]))
    assert record["percentile_10"] == pytest.approx(np.percentile(record["returns"], 10))
    assert (len(record["returns"]), record["episodes"]) == (2, 2)
    assert "step" not in record


def test_a_run_is_evaluated_as_it_was_while_it_trained(run):
    at_end = [row.episode_return for row in read_evaluations(run) if row.step == 80]
    (rollout,) = find_player(str(run)).play([0])
    assert rollout.reward.sum() == pytest.approx(at_end[0], abs=2e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--encoder", "dae-8"), "which has its own encoder: leave out --encoder"),
        (("--task", "move_to_pose"), "is of face_direction, not of move_to_pose"),
        (("--episodes", "1e9"), "1,000,000,000 episodes are too many: at most 10,000"),
    ],
)
def test_options_that_a_run_refuses(arguments, message, run):
    told = jbrep("evaluate-policy", run, *arguments)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    assert message in told.output


def test_which_encoder_a_policy_by_name_observes_through(tmp_path):
    file = tmp_path / "own.safetensors"
    save(find("dae-8", TASK), file)
    played = ("evaluate-policy", "heuristic", "--episodes", 1, "--encoder")
    told = jbrep(*played, "dae-8").output
    assert told.startswith("encoder: dae-8, shipped\nface_direction, heuristic on dae-8, decoded: ")
    record = json.loads(jbrep(*played, file, "--json").output)
    assert record["encoder"] == str(file)
    assert record["representation"] == "dae-8, decoded"
    assert f"median return {record['median']:.0f} [" in told


def test_episodes_are_as_long_as_the_run_s(run):
    shorten(run, 30)
    (rollout,) = find_player(str(run)).play([0])
    assert len(rollout) == 30


def test_more_episodes_than_memory_holds_are_not_played(run):
    shorten(run, 10**6, evaluation_episodes=10_000)
    told = jbrep("inspect", run, "--out", run / "it.rrd")
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    assert "plays 10,000 episodes of 1,000,000 steps at once" in told.output


def test_another_encoder_is_not_the_run_s(run):
    save(find("pca-8", TASK), run / ENCODER)
    assert "is not the encoder that the run in" in refused(load_run, run)
    settings = json.loads((run / RUN).read_text())["settings"]
    own = find("pca-8", TASK).fingerprint
    pose = {"task": "move_to_pose", "environment": to_plain(describe("move_to_pose"))}
    change(run, settings={**settings, "encoder": own, **pose})
    assert "was made for face_direction" in refused(load_run, run)


def test_a_large_policy_is_recognised(tmp_path):
    path = tmp_path / "large.safetensors"
    weights = {"policy.weight": np.zeros((2200, 2200), np.float32)}  # 19 MB
    container.write(path, weights, {"format": POLICY_FORMAT, "format_version": 1})
    assert is_policy_file(path)
    path.write_bytes(path.read_bytes()[:100])
    assert not is_policy_file(path)


def test_tensorboard_keeps_what_was_logged_at_the_step_of_a_checkpoint(tmp_path):
    for step in (0, 20):  # before it was stopped, and after
        scalars = Scalars(tmp_path, step)
        scalars.write({"evaluation": 1.0}, {"evaluation": ()}, step + 20)
        scalars.write({"evaluation": 2.0}, {"evaluation": ()}, step + 30)
        scalars.close()
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [e.step for e in events.Scalars("evaluation")] == [20, 40, 50]
