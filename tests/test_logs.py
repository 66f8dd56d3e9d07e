"""Logs of real robots: layouts as loggers write them, incomplete and contradictory as they are."""

import json
import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import foreign
import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import jbrep, mistake
from drawn import FILES, Truth, frame
from foreign import csv_rows, imported, lerobot_folder, not_imported, write_csv, write_d4rl
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from small import settings

from jbrep.collecting import collect
from jbrep.collecting.derive import derive
from jbrep.dataset import Dataset, Layout, ScaledDataset, from_arrays, from_file, from_table
from jbrep.dataset.formats import FORMATS, export, open_sources
from jbrep.dataset.formats.writer import write
from jbrep.dataset.manifest import find_problems
from jbrep.envs import describe
from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError
from jbrep.evaluation.diagnosis import diagnose
from jbrep.methods.fit import Fitter

NAMED = ("--observations", "pitch,gyro,ticks", "--actions", "u", "--time", "time")


def test_a_csv_as_loggers_write_it(tmp_path):
    """Comments, units in the header, decimal commas, words, angles in degrees, a pause."""
    path = write_csv(tmp_path / "a.csv", csv_rows(), ";", ["# logger 2.1", ""], ",")
    told, data = imported(path, *NAMED, "--gap", "0.5", "--angles", "pitch")
    assert data.episodes["length"].tolist() == [59, 59]
    named = [(f.name, f.unit, f.kind) for f in data.task.features]
    assert named[:2] == [("pitch", "rad", "angle"), ("gyro", "rad/s", "scalar")]
    assert named[2:] == [("ticks", "", "scalar")]
    kept = np.delete(np.arange(120), [59, 119])
    turned = np.asarray(data["pitch"]) - np.radians(foreign.PITCH[kept])
    assert np.abs(np.angle(np.exp(1j * turned))).max() < 1e-5
    np.testing.assert_allclose(data["gyro"], foreign.GYRO[kept], rtol=1e-6)
    assert data.task.timestep == 1 / foreign.RATE
    assert data.columns == ("observation", "action", "episode", "step")
    assert "not used: status" in told
    assert "ticks is from 420000000" in told


def test_a_jump_by_a_full_turn_is_told_unless_the_unit_denies_it(tmp_path):
    saw = [round(0.3 * i % 6.28318, 5) for i in range(200)]
    path = write_csv(tmp_path / "s.csv", {"my turn": saw, "a [deg]": saw, "b [°C]": saw, "u": saw})
    told, _ = imported(path, "--actions", "u", "--length", "200", out="saw")
    assert told.count("full turn") == 1
    assert "--angles 'my turn' --units 'my turn=rad'" in told


def test_missing_cells_are_cut_or_held_and_counted(tmp_path):
    path = write_csv(tmp_path / "a.csv", csv_rows(gyro=dict.fromkeys((30, 31), "")))
    assert "a.csv, line 32: 'gyro' is empty" in not_imported(path, *NAMED, "--gap", "1")
    _, data = imported(path, *NAMED, "--gap", "1", "--missing", "skip")
    assert data.episodes["length"].tolist() == [29, 27, 59]
    _, data = imported(path, *NAMED, "--gap", "1", "--missing", "hold:2", out="held")
    np.testing.assert_allclose(data["gyro"][29:33], [8.29, 8.29, 8.29, 8.32], rtol=1e-6)
    assert data.episodes["missing"].tolist() == [2, 0]
    turns = {"x": [0, 1, "", 3, "", 5], "y": [0, "", 2, "", 4, ""], "u": [0.5] * 6}
    path, names = write_csv(tmp_path / "b.csv", turns), ("--actions", "u", "--length", "9")
    _, data = imported(path, *names, "--missing", "hold:1", out="turns")
    assert data["observation"][:].tolist() == [[0, 0], [1, 0], [1, 2], [3, 2], [3, 4]]
    for column, cells, place in (("x", ["", *range(5)], "0"), ("u", [0, 1, "", 3, 4, 5], "2")):
        write_csv(path, turns | {column: cells})
        assert f"at step {place}" in not_imported(path, *names, "--missing", "hold:1")


def test_uneven_clocks_are_brought_to_an_even_one(tmp_path):
    """By the latest value, or linearly, the shorter way round for an angle."""
    time = np.sort(np.random.default_rng(0).uniform(0, 2, 400))
    time[200:] += 3
    frame = pandas.DataFrame({"t": time * 1000, "angle": np.angle(np.exp(8j * time)), "u": time})
    frame["flag"] = frame.index % 2
    layout = Layout(
        observations=("angle",), actions=("u",), time="t", units={"t": "ms"}, gap=1, rate=50
    )
    data = from_table(tmp_path / "latest", frame, layout)
    assert len(data.episodes["length"]) == 2
    grid = time[0] + np.arange(data.episodes["length"][0]) / 50
    latest = time[np.searchsorted(time, grid + 1e-9, side="right") - 1]
    np.testing.assert_allclose(data.episode(0)["action"][:, 0], latest, rtol=1e-6)
    layout = layout.replace(angles=("angle",), fill="linear")
    data = from_table(tmp_path / "linear", polars.DataFrame(frame), layout)
    apart = data.episode(0)["observation"][:, 0] - 8 * grid
    assert np.abs(np.angle(np.exp(1j * apart))).max() < 0.01
    assert data.task.timestep == 1 / 50


def test_columns_that_come_at_their_own_rates_meet_on_one_clock(tmp_path):
    """Rows with a cell each, as loggers of several devices write; one is silent for a while."""
    slow = ["" if i % 10 else f"{i}" for i in range(120)]
    rows = {"t": [f"{i / 100}" for i in range(120)], "slow": slow}
    rows["u"] = ["" if 40 < i < 80 else f"{i}" for i in range(120)]
    path = write_csv(tmp_path / "a.csv", rows)
    names = ("--observations", "slow", "--actions", "u", "--time", "t", "--rate", "100")
    _, data = imported(path, *names, "--gap", "0.2")
    assert data.episodes["length"].tolist() == [60, 39]
    np.testing.assert_array_equal(data.episode(0)["observation"][:, 0], np.arange(60) // 10 * 10)
    assert data.episode(0)["action"][-1] == 40


REWARD = """
import numpy as np
def upright(observations, actions):
    observations *= 1  # what it is given is its own
    return np.cos(observations[:, 0]) - 0.01 * (actions**2).sum(axis=1)
def scalar(observations, actions):
    return 1.0
def endless(observations, actions):
    return np.where(np.arange(len(actions)) == 7, np.inf, 0)
"""


@pytest.fixture
def rewards(tmp_path, monkeypatch):
    (tmp_path / "my_rewards.py").write_text(REWARD)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    yield
    sys.modules.pop("my_rewards", None)


def test_an_own_reward_after_the_fact(tmp_path, rewards):
    path = write_csv(tmp_path / "a.csv", csv_rows())
    options = (*NAMED, "--gap", "1", "--angles", "pitch")
    (tmp_path / "layout.toml").write_text('reward = "my_rewards:upright"\n')
    done = jbrep("data", "import", path, *options, "--layout", "layout.toml", "--out", "no")
    assert "the reward my_rewards:upright is code: importing my_rewards runs it" in done.output
    _, data = imported(path, *options, "--reward", "my_rewards:upright")
    expected = np.cos(data["pitch"]) - 0.01 * np.asarray(data["action"])[:, 0] ** 2
    np.testing.assert_allclose(data["reward"], expected, rtol=1e-5)
    assert data.manifest.settings.reward.startswith("my_rewards:upright ")


def test_rewards_for_data_that_exist_already(tmp_path, rewards):
    """Collected or imported, with rewards or without; also of what is hidden then."""
    _, log = imported(write_csv(tmp_path / "a.csv", csv_rows()), *NAMED, "--gap", "1")
    brief = describe("face_direction", episode_steps=30)
    collect(settings(brief, steps=90, shard_episodes=2), tmp_path / "collected")
    code, hidden = ("--reward", "my_rewards:upright"), ("--hide", "gyro", "--history", "2")
    for source, others in ((log.folder, hidden), (tmp_path / "collected", ())):
        done = jbrep("data", "derive", source, *code, *others, "--out", f"{source}-rewarded")
        assert done.exit_code == 0, done.output
        before, data = Dataset(source), Dataset(f"{source}-rewarded")
        first, action = np.asarray(before[before.task.feature_names[0]]), before["action"][:, 0]
        np.testing.assert_allclose(data["reward"], np.cos(first) - 0.01 * action**2, rtol=1e-5)
        assert not list(find_problems(data.folder))
        assert (data.task.reward_high, data.task.solved_return) == (None, None)
    assert data.episodes["return"][0] == data["reward"][:30].astype(float).sum()
    replayed = jbrep("data", "verify", data.folder, "--replay", "2")
    assert "2 episodes simulated again: equal in every bit" in replayed.output
    derive = ("data", "derive", tmp_path / "collected", "--out")
    for name in ("my_rewards:scalar", "my_rewards:endless", "my_rewards:fly", "upright"):
        assert name.removeprefix("my_rewards:") in mistake(
            *derive, tmp_path / name, "--reward", name
        )
        assert not list(tmp_path.glob(f"{name}/*.h5"))
    Path("my_rewards.py").write_text(f"{REWARD}# mended\n")
    assert "reward my_rewards:upright" in mistake(*derive, data.folder, *code)


def test_a_folder_holds_what_was_derived_from_one_import(tmp_path):
    """Of a log that was corrected and imported once more: with the same settings, or more rows."""
    derived = tmp_path / "derived"
    source = {}
    for name, sign, trials in (("a", 1, 5), ("b", -1, 5), ("c", -1, 9), ("d", 1, 9)):
        rows = np.arange(20 * trials)
        table = {"x": sign * np.sin(rows), "y": rows, "u": np.cos(rows), "trial": rows // 20}
        path = write_csv(tmp_path / "log.csv", table)
        source[name] = imported(path, "--actions", "u", "--episode", "trial", out=name)[1].folder
    derive(source["a"], derived, ["y"])
    for other in "bc":
        with pytest.raises(InputError, match=str(source[other])):
            derive(source[other], derived, ["y"])
    derive(source["d"], derived, ["y"])
    np.testing.assert_array_equal(Dataset(derived)["x"], Dataset(source["d"])["x"])


def test_data_without_rewards_go_through_what_needs_none(tmp_path):
    random = np.random.default_rng(0)
    position = np.cumsum(random.normal(size=(300, 2)), axis=0)
    action = random.uniform(-1, 1, (300, 1))
    ends = np.arange(300) % 30 == 29
    data = from_arrays(tmp_path / "data", position, action, None, ends, source="walks")
    scaled = ScaledDataset(data)
    fitter = Fitter(scaled, tmp_path / "encoders")
    encoder = fitter.fit("linear-forward", latent=1).encoder
    evaluation = diagnose({"code": encoder}, scaled)
    assert evaluation.encoders["code"].prediction["5"].mean.value is not None
    with pytest.raises(InputError, match="deepmdp needs a reward that varies"):
        fitter.plan("deepmdp", latent=1)
    done = jbrep("data", "export", data.folder, "--to", "minari", "--out", tmp_path / "out")
    assert f"{data.folder} has no rewards: jbrep data derive --reward gives some\n" in done.output


BAD = {  # words of the line that refuses it: the place, and the column or option
    "line 6 gyro 1,5.2": ({"gyro": {4: '"1,5.2"'}}, NAMED),
    "line 9 expected 6 got 7": ({"status": {7: "a,b"}}, NAMED),
    "line 7 u": ({"u": {5: "inf"}}, NAMED),
    "column speed pitch": ({}, (*NAMED[:1], "speed", *NAMED[2:])),
    "line 2 status": ({}, ("--actions", "u", "--time", "time")),
    "--time --episode --length": ({}, NAMED[:4]),
    "time days ms": ({}, (*NAMED, "--units", "time=days")),
    "gyro rad/s deg": ({}, (*NAMED, "--angles", "gyro")),
    "observation u pitch": ({}, (*NAMED, "--angles", "u")),
    "episode two parts": ({"status": {9: "b"}}, (*NAMED, "--episode", "status")),
    "--fill --rate": ({}, (*NAMED, "--fill", "linear")),
    "rows field larger": ({"status": {3: "a" * 200_000}}, NAMED),
}


@pytest.mark.parametrize("words", BAD)
def test_what_is_wrong_is_told_in_a_line_with_its_place(words, tmp_path):
    changes, options = BAD[words]
    told = not_imported(write_csv(tmp_path / "a.csv", csv_rows(**changes)), *options)
    assert all(word in told for word in words.split())


def test_lists_in_a_table_and_integers_as_actions(tmp_path):
    frame = polars.DataFrame(
        {
            "observation": [[i / 1, i / 2] for i in range(40)],
            "pulse": [1000 + 10 * i for i in range(40)],
            "trial": ["a"] * 20 + ["b"] * 20,
        }
    )
    frame.write_parquet(tmp_path / "a.parquet")
    _, data = imported(tmp_path / "a.parquet", "--actions", "pulse", "--episode", "trial")
    assert data.task.feature_names == ("observation_0", "observation_1")
    assert (data.task.action_low, data.task.action_high) == ((1000,), (1380,))


def test_several_logs_of_one_clock_are_an_episode_each(tmp_path):
    first = write_csv(tmp_path / "a.csv", csv_rows())
    second = write_csv(tmp_path / "b.csv", csv_rows())
    _, data = imported(first, second, *NAMED, "--length", "100")
    assert data.episodes["length"].tolist() == [99, 19, 99, 19]
    (tmp_path / "c.csv").symlink_to(first)
    said = mistake("data", "import", first, second, tmp_path / "c.csv", *NAMED, "--out", "no")
    assert "c.csv is given twice" in said
    slow = csv_rows(time={row: f"{10 * t:.5f}" for row, t in enumerate(foreign.TIMES)})
    told = not_imported(first, write_csv(tmp_path / "slow.csv", slow), *NAMED)
    assert all(word in told for word in ("slow.csv", "timestep"))


def test_a_lerobot_data_set(tmp_path):
    told, data = imported(lerobot_folder(tmp_path / "arm"))
    assert data.task.feature_names == ("shoulder.pos", "elbow.pos")
    assert "observation.images.top" in told
    assert data.task.action_names == ("shoulder.pos", "elbow.pos")
    for wrong in (("a",), ("a", "a"), ("a", "b", "c"), ("a", "b", "b")):
        with pytest.raises(InputError, match="one for each number"):
            data.task.replace(action_names=wrong)
    assert "shoulder.pos, elbow.pos" in jbrep("data", "info", data.folder).output
    _, few = imported(tmp_path / "arm", "--observations", "observation.state.elbow*", out="few")
    assert few.task.feature_names == ("elbow.pos",)
    jbrep("data", "export", few.folder, "--to", "lerobot", "--out", tmp_path / "out")
    file = tmp_path / "out/data/chunk-000/file-000.parquet"
    assert pq.read_schema(file).field("observation.state").type == pa.float32()  # as LeRobot has it
    _, again = imported(tmp_path / "out", out="again")
    assert again.task.feature_names == few.task.feature_names


def test_what_is_exported_to_lerobot_has_its_layout_and_comes_back(tmp_path):
    _, data = imported(lerobot_folder(tmp_path / "arm"))
    out = tmp_path / "again"
    export(data, "lerobot", out)
    info = json.loads((out / "meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (30, 3, 30)
    assert pandas.read_parquet(out / "meta/tasks.parquet").loc[data.task.name].task_index == 0
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [each["dataset_to_index"] for each in episodes] == [9, 19, 30]
    _, back = imported(out, out="back")  # without the last steps, whose next states have no place
    assert back.episodes["length"].tolist() == [8, 9, 10]
    np.testing.assert_array_equal(back["action"][:8], data["action"][:8])
    assert back.task.features == data.task.features
    assert back.task.action_names == data.task.action_names
    unknown = from_table(
        tmp_path / "unknown", {"x": [0.0, 1, 2], "action": [0.5] * 3}, Layout(length=9)
    )
    with pytest.raises(InputError, match="timestep"):
        export(unknown, "lerobot", tmp_path / "no")


@pytest.mark.filterwarnings("ignore:.*is from 1000000")
@pytest.mark.parametrize("form", FORMATS)
def test_an_offset_is_taken_off_once(form, tmp_path):
    """Of features that lack it already nothing, of others all."""
    rows = {"t": np.arange(8) / 10, "x": 1e6 + np.arange(8) / 8, "u": np.full(8, 0.5)}
    rows["reward"] = np.zeros(8)
    layout = Layout(observations=("x",), actions=("u",), time="t")
    plain = from_table(tmp_path / "plain", rows, layout)
    features = tmp_path / "features.toml"
    features.write_text("[[features]]\noffset = 1000000\n")
    path = write_csv(tmp_path / "a.csv", {name: values.tolist() for name, values in rows.items()})
    how = ("--observations", "x", "--actions", "u", "--time", "t", "--features", features)
    _, shifted = imported(path, *how, out="shifted")
    np.testing.assert_array_equal(shifted["observation"][:, 0], np.arange(7) / 8)
    for data in (plain, shifted):
        out = tmp_path / f"{data.folder.name}.{form}"
        export(data, form, out)
        source = next(out.glob("*/*/data")).parent if form == "minari" else out
        _, back = imported(source, "--features", features, out=f"{data.folder.name}-back")
        assert back.task.offset.tolist() == [1e6]
        seen = back["observation"][:, 0]
        np.testing.assert_array_equal(seen, np.arange(7)[: len(seen)] / 8)


def test_a_pause_within_an_episode_is_told(tmp_path):
    path, how = tmp_path / "a.csv", ("--observations", "x", "--actions", "u", "--time", "t")
    times = [*range(20), *range(80, 100)]
    path.write_text("t,x,u\n" + "".join(f"{time},{time},0\n" for time in times))
    assert "1 pause" in imported(path, *how)[0]
    assert "1 pause" not in imported(path, *how, "--gap", "30", out="cut")[0]


@pytest.mark.parametrize(
    ("kind", "compressed"),
    [
        ("bag", (Writer1.CompressionFormat.LZ4,)),
        ("mcap", ()),
        ("db3", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ],
)
def test_a_bag_of_ros(kind, compressed, tmp_path):
    path = tmp_path / ("walk.bag" if kind == "bag" else "walk")
    foreign.write_bag(path, kind, compressed=compressed)
    names = ("--observations", "/joint_states.position.*", "--actions", "/arm/command.data")
    _, data = imported(path, *names, "--rate", "50", "--gap", "0.15")
    assert data.task.feature_names == ("joint_states.position.hip", "joint_states.position.knee")
    assert (data.task.timestep, data.task.id) == (1 / 50, "walk")
    assert data.episodes["length"].tolist() == [52, 47]
    hip, knee = data.episode(0)["observation"].T
    np.testing.assert_allclose(hip, 0.05 + np.arange(52) / 50, atol=1e-6)
    np.testing.assert_allclose(knee, -hip)
    assert data.episode(0)["action"][:6, 0].tolist() == [5, 5, 5, 5, 5, 15]
    if kind == "mcap":
        (file,) = path.glob("*.mcap")
        _, same = imported(file, *names, "--rate", "50", "--gap", "0.15", out="same")
        np.testing.assert_array_equal(same["observation"], data["observation"])


def test_numbers_that_come_late_in_a_bag_are_missed_if_they_are_asked_for(tmp_path):
    path = foreign.write_bag(tmp_path / "walk", "mcap", silent=range(220))
    how = ("--actions", "/arm/command.data", "--rate", "50", "--observations")
    assert len(imported(path, *how, "/joint_states.header.stamp.sec")[1])
    assert "/joint_states.position" in not_imported(path, *how, "/joint_states.*")


@pytest.mark.parametrize(
    ("header", "told"),
    [
        ("t,velocity [rad/s],cosine,sine,u", "'velocity' where Pendulum-v1 has 'cosine'"),
        ("t,cosine,sine,velocity [deg/s],u", "'velocity' in deg/s, and Pendulum-v1 in rad/s"),
        ("t,cosine,sine,velocity,u", "0.02 s apart, but steps of Pendulum-v1 take 0.05 s"),
    ],
)
def test_a_log_in_another_order_units_or_clock_than_its_task_is_refused(header, told, tmp_path):
    named = tmp_path / "names.toml"
    named.write_text(
        "[[features]]\nname = 'cosine'\n[[features]]\nname = 'sine'\n"
        "[[features]]\nname = 'velocity'\nunit = 'rad/s'\n"
    )
    task = describe("Pendulum-v1", features=named)
    path = tmp_path / "log.csv"
    rows = "".join(f"{i / 50},1,0,0,{i % 2}\n" for i in range(20))
    path.write_text(f"{header}\n{rows}")
    layout = Layout(time="t", observations=(*re.findall(r"cosine|sine|velocity", header),))
    with pytest.raises(InputError, match=re.escape(told)):
        from_file(tmp_path / "out", path, layout=layout.replace(actions=("u",)), task=task)


def test_a_bag_reads_nothing_outside_itself_and_opens_no_pipe(tmp_path):
    path = foreign.write_bag(tmp_path / "walk", "db3")
    about, database = path / "metadata.yaml", path / "walk.db3"
    elsewhere = path / "..%2Felsewhere.db3"  # which SQLite takes for ../elsewhere.db3
    shutil.copy(database, tmp_path / "elsewhere.db3")
    elsewhere.touch()
    said = about.read_text()
    about.write_text(said.replace("walk.db3", elsewhere.name))
    assert elsewhere.name in not_imported(path)
    about.write_text(said)
    elsewhere.unlink()
    for make in (lambda: database.symlink_to(tmp_path / "elsewhere.db3"), lambda: os.mkfifo(about)):
        for each in (database, about):
            each.unlink(missing_ok=True)
        make()
        about.exists() or about.write_text(said)
        assert "must be a plain file" in not_imported(path)


def test_the_page_on_logs_does_what_it_says(tmp_path, monkeypatch):
    """Its first block of Python writes a log, its commands import it."""
    page = (Path(__file__).parent.parent / "docs/logs.md").read_text().partition("\n## ")[0]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    exec(re.search(r"^```python\n(.*?)^```", page, re.M | re.S)[1], {})
    told = [jbrep(*shlex.split(line)) for line in re.findall(r"^ {4}jbrep (.*)", page, re.M)]
    assert [done.exit_code for done in told] == [0] * len(told) == [0] * 6, told
    sys.modules.pop("my_rewards", None)


def test_an_option_comes_before_the_file_even_where_it_is_the_default(tmp_path):
    rows = {"t": [i / 5 for i in range(6)], "x": range(6), "u": [0.5] * 6}
    path, file = write_csv(tmp_path / "a.csv", rows), tmp_path / "layout.toml"
    file.write_text('observations=["x"]\nactions=["u"]\ntime="t"\nrate=10\nfill="linear"\n')
    _, data = imported(path, "--layout", file)
    np.testing.assert_allclose(data["x"][:4], [0, 0.5, 1, 1.5], rtol=1e-6)
    _, data = imported(path, "--layout", file, "--fill", "latest", out="latest")
    np.testing.assert_array_equal(data["x"][:4], [0, 0, 1, 1])


def test_a_clock_that_is_rounded_keeps_every_row(tmp_path):
    rows = np.arange(301)
    table = {"t": np.round(rows / 60, 3), "x": rows * 1.0, "u": rows * 1.0}
    layout = Layout(observations=("x",), actions=("u",), time="t", rate=60)
    data = from_table(tmp_path / "even", table, layout)
    np.testing.assert_array_equal(data["x"][:], rows[:-1])
    data = from_table(tmp_path / "own", table, layout.replace(rate=None))
    assert data.task.timestep == 1 / 60


def test_whole_numbers_that_floats_do_not_hold_are_refused(tmp_path):
    """With their place."""
    table = {"t": np.arange(8) / 10, "x": (1 << 53) + np.arange(8), "u": np.zeros(8)}
    layout = Layout(observations=("x",), actions=("u",), time="t")
    with pytest.raises(InputError, match=r"table, row 1.*'x'.*9007199254740993"):
        from_table(tmp_path / "a", table, layout)
    table["x"] -= 1
    path = write_csv(tmp_path / "a.csv", {name: each.tolist() for name, each in table.items()})
    with pytest.raises(InputError, match=r"a\.csv, line 4.*'x'.*9007199254740993"):
        from_file(tmp_path / "b", path, layout=layout)


def test_lerobot_data_sets_that_are_not_whole_are_refused(tmp_path):
    folder = lerobot_folder(tmp_path / "new", "v4.0")
    assert "layout v4.0" in not_imported(folder)
    known = {"codebase_version": "v3.0", "fps": 30, "features": {}, "total_frames": 10_000}
    for told, problem in (({}, "codebase_version"), (known, "10,000"), (known | {"fps": 0}, "0.0")):
        (folder / "meta/info.json").write_text(json.dumps(told))
        assert problem in not_imported(folder)
    shutil.rmtree(folder / "data")
    (folder / "meta/info.json").write_text(json.dumps(known))
    assert "has no data/chunk-*/*.parquet" in not_imported(folder)


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.csv", b"", "is empty"),
        ("a.csv", b"1,2\n3,4\n", "line 1: a number"),
        ("a.csv", b"a,b\n\xff\xfe,3\n", "UTF-8"),
        *((f"a.{kind}", b"nonsense" * 20, "as a bag") for kind in ("bag", "mcap", "db3")),
        ("a.hdf5", b"nonsense" * 20, "as an HDF5 file"),
    ],
)
def test_a_file_that_is_no_log_is_refused(name, content, problem, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert problem in not_imported(tmp_path / name)


def test_how_an_episode_ends_is_kept_where_its_last_time_is_there_twice(tmp_path):
    x = np.arange(6.0)
    rows = {"t": [0, 1, 2, 3, 4, 4], "observation": x, "action": np.full(6, 0.5)}
    rows |= {"next_observation": x + 1, "terminated": x == 5}
    data = from_table(tmp_path / "a", rows, Layout(time="t"))
    assert data.episodes["terminated"].tolist() == [True]
    assert data.episodes["final_observation"].tolist() == [[6]]


@pytest.mark.parametrize(("rate", "last"), [(100, 39), (30, 36)])
def test_an_even_clock_keeps_what_came_after_the_last_action(rate, last, tmp_path):
    x = np.arange(40.0)
    rows = {"t": x / 100, "observation": x, "next_observation": x + 1, "action": x}
    rows["terminated"] = x == 39
    data = from_table(tmp_path / "a", rows, Layout(time="t", rate=rate))
    assert data.episodes["length"].tolist() == [rate * 0.4]
    assert data.episodes["terminated"].tolist() == [True]
    assert data.episodes["final_observation"].tolist() == [[40]]
    assert data["observation"][-1] == data["action"][-1] == last


def test_no_link_in_a_lerobot_data_set_is_followed(tmp_path):
    folder = lerobot_folder(tmp_path / "le")
    shutil.move(folder / "data/chunk-000", tmp_path / "elsewhere")
    (folder / "data/chunk-000").symlink_to(tmp_path / "elsewhere")
    assert "chunk-000 must be a plain file" in not_imported(folder)


CLOCK = np.arange(60) / 20
TABLE = {"t": CLOCK, "yaw_deg": (90 * CLOCK + 180) % 360 - 180, "x": CLOCK, "u": np.sin(CLOCK)}
TIMED = ("--actions", "u", "--time", "t")


def test_a_rate_that_timestamps_contradict(tmp_path):
    folder = lerobot_folder(tmp_path / "le")
    info = json.loads((folder / "meta/info.json").read_text()) | {"fps": 15}
    assert "timestamps are" not in imported(folder, out="plain")[0]
    (folder / "meta/info.json").write_text(json.dumps(info))
    told, data = imported(folder, out="rate")
    assert "timestamps are" in told
    assert data.task.timestep == pytest.approx(1 / 15)
    _, data = imported(folder, "--time", "timestamp", out="stamps")
    assert data.task.timestep == pytest.approx(1 / 30, rel=1e-3)


def test_degrees_are_never_taken_for_radians(tmp_path):
    path = write_csv(tmp_path / "a.csv", TABLE)
    assert "--units yaw_deg=deg" in not_imported(path, *TIMED, "--angles", "yaw_deg")
    renamed = {"t": CLOCK, "yaw": TABLE["yaw_deg"], "u": TABLE["u"]}
    other = write_csv(tmp_path / "b.csv", renamed)
    assert "--units yaw=deg" in not_imported(other, *TIMED, "--angles", "yaw")
    assert "--angles yaw --units yaw=deg" in imported(other, *TIMED, out="b")[0]  # it jumps
    _, data = imported(path, *TIMED, "--angles", "yaw_deg", "--units", "yaw_deg=deg", out="c")
    assert data.task.feature_names == ("yaw", "x")
    np.testing.assert_allclose(data["yaw"][:], np.radians(TABLE["yaw_deg"][:-1]), atol=1e-6)
    _, data = imported(path, *TIMED, out="d")
    assert data.task.features[0].unit == ""


def test_ends_that_a_file_does_not_tell(tmp_path):
    assert "no timeouts" in imported(write_d4rl(tmp_path / "a.hdf5", timeouts=None), out="a")[0]
    assert "no timeouts" not in imported(write_d4rl(tmp_path / "b.hdf5"), out="b")[0]
    stays = np.isin(np.arange(25), (9, 10, 11, 24))
    told = imported(write_d4rl(tmp_path / "c.hdf5", terminals=stays, timeouts=None), out="c")[0]
    assert "2 rows terminated right after one that was" in told


def test_messages_in_bursts(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    number = store.types["std_msgs/msg/Float64"]
    with Writer(tmp_path / "walk", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [writer.add_connection(f"/{n}", number.__msgtype__, typestore=store) for n in "xu"]
        for i in range(600):
            burst = 10**9 + i // 10 * 100_000_000 + i % 10 * 1000
            even = 10**9 + i * 10_000_000
            for topic, time, value in zip(topics, (burst, even), (float(i), 0.5), strict=True):
                told = store.serialize_cdr(number(value), number.__msgtype__)
                writer.write(topic, time, told)
    names = ("--observations", "/x.data", "--actions", "/u.data")
    told, _ = imported(tmp_path / "walk", *names, "--rate", "100")
    assert "480 readings of /x.data in bursts" in told


def test_work_out_of_measure_is_refused_with_the_rows_that_it_would_make(tmp_path):
    rows = {"t": (0, 1, 199_998, 199_999), **{f"x{i}": np.ones(4) for i in range(100)}}
    path = write_csv(tmp_path / "a.csv", rows | {"u": (0, 1, 0, 1)})
    assert "an episode of 4 rows" in not_imported(path, *TIMED, "--rate", "100")
    table = pa.table({"t": [-(2**63), 0, 2**63 - 1], "x": [0.0, 1, 2], "u": [0.0, 1, 2]})
    pq.write_table(table, tmp_path / "d.parquet")
    assert "too far apart" in not_imported(tmp_path / "d.parquet", *TIMED)


def test_bags_without_metadata_and_columns_without_readings(tmp_path):
    path = foreign.write_bag(tmp_path / "walk", "mcap")
    (path / "metadata.yaml").unlink()
    names = ("--observations", "/joint_states.*.hip", "--actions", "/arm/command.data")
    assert "walk.mcap" in not_imported(path, *names, "--rate", "9")
    rows = {"t": CLOCK, "x": CLOCK, "gone": np.full(60, np.nan), "u": CLOCK}
    told = not_imported(write_csv(tmp_path / "a.csv", rows), *TIMED, "--rate", "9")
    assert "without a reading of gone" in told


def test_a_file_that_changes_while_it_is_read_is_refused(tmp_path):
    path = write_csv(tmp_path / "a.csv", TABLE)
    source = open_sources([str(path)], Layout(actions=("u",), time="t"))
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match="changed while it was imported"):
        write(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_names_of_files_that_are_not_utf_8(tmp_path):
    pq.write_table(pa.table(TABLE), tmp_path / "a.parquet")
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/Messung_\xfc.parquet")
    shutil.move(tmp_path / "a.parquet", odd)
    assert len(imported(tmp_path / odd, *TIMED)[1]) == 59


def test_more_features_than_a_shard_names_are_refused_at_once(tmp_path):
    rows = {"actions": np.zeros((9, 1), "f4"), "terminations": np.arange(9) == 8}
    np.savez(tmp_path / "a.npz", observations=np.zeros((9, MAX_FEATURES + 1), "f4"), **rows)
    assert "observation" in not_imported(tmp_path / "a.npz")


@pytest.mark.parametrize("separator", [",", "\t", "|"])
def test_marks_of_thousands_are_never_taken_for_decimal_ones(separator, tmp_path):
    def log(name, cell):
        rows = [["t", "x", "u"], *([f"{i}", f'"{cell}"', f'"{i}"'] for i in range(9))]
        path = tmp_path / name
        path.write_text("\n".join(separator.join(row) for row in rows) + "\n")
        return path

    assert "1,234" in not_imported(log("a.csv", "1,234"), *TIMED)
    _, data = imported(log("b.csv", "0,234"), *TIMED)
    assert data["x"][0] == np.float32(0.234)


def test_rows_with_old_readings_are_counted_apart_from_those_dropped(tmp_path):
    """Silent for 0.6 s, and for 1.5: held for a second, but from the third interval on old."""
    times = np.arange(60) / 10
    seen = np.where((np.arange(60) >= 20) & (np.arange(60) < 26), np.nan, times)
    seen[40:55] = np.nan
    path = write_csv(tmp_path / "a.csv", {"t": times, "x": seen, "u": times})
    source = open_sources([str(path)], Layout(actions=("u",), time="t", rate=10, gap=1.0))
    list(source.episodes())
    counted = {what: n for (_, what), n in source.changes().items()}
    assert counted["dropped, as a column was silent for more than 1.0 s"] == 5
    assert counted["kept with a reading older than two of its usual intervals"] == 4 + 8


@pytest.mark.parametrize("form", FILES)
def test_files_are_read_back(form, tmp_path):
    for seed in range({"text": 40, "bag": 9}.get(form, 6)):
        random = np.random.default_rng(seed)
        truth, folder = Truth.drawn(random), tmp_path / str(seed)
        folder.mkdir()
        path, options, lacks = FILES[form](truth, random, folder / "log")
        _, data = imported(path, *options)
        truth.check(data, **lacks)


def test_frames_are_read_back(tmp_path):
    for seed in range(12):
        random = np.random.default_rng(seed)
        truth = Truth.drawn(random)
        names = {"observations": tuple(truth.features), "actions": tuple(truth.commands)}
        layout = Layout(**names, time="t", episode="trial", reward="gain")
        truth.check(from_table(tmp_path / str(seed), frame(truth, random), layout))
