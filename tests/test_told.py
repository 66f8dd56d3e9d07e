"""What a log contradicts itself in, or what would be taken otherwise than it is meant, is told."""

import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from foreign import imported, lerobot_folder, not_imported, write_bag, write_csv, write_d4rl
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from jbrep.dataset import Layout
from jbrep.dataset.formats import open_sources
from jbrep.dataset.formats.writer import write
from jbrep.envs.task import MAX_FEATURES
from jbrep.errors import InputError

TIMES = np.arange(60) / 20
TABLE = {"t": TIMES, "yaw_deg": (90 * TIMES + 180) % 360 - 180, "x": TIMES, "u": np.sin(TIMES)}
NAMED = ("--actions", "u", "--time", "t")


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
    assert "--units yaw_deg=deg" in not_imported(path, *NAMED, "--angles", "yaw_deg")
    renamed = {"t": TIMES, "yaw": TABLE["yaw_deg"], "u": TABLE["u"]}
    other = write_csv(tmp_path / "b.csv", renamed)
    assert "--units yaw=deg" in not_imported(other, *NAMED, "--angles", "yaw")
    assert "--angles yaw --units yaw=deg" in imported(other, *NAMED, out="b")[0]  # it jumps
    _, data = imported(path, *NAMED, "--angles", "yaw_deg", "--units", "yaw_deg=deg", out="c")
    assert data.task.feature_names == ("yaw", "x")
    np.testing.assert_allclose(data["yaw"][:], np.radians(TABLE["yaw_deg"][:-1]), atol=1e-6)
    _, data = imported(path, *NAMED, out="d")
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
            writer.write(
                topics[0], burst, store.serialize_cdr(number(float(i)), number.__msgtype__)
            )
            even = 10**9 + i * 10_000_000
            writer.write(topics[1], even, store.serialize_cdr(number(0.5), number.__msgtype__))
    names = ("--observations", "/x.data", "--actions", "/u.data")
    told, _ = imported(tmp_path / "walk", *names, "--rate", "100")
    assert "480 readings of /x.data in bursts" in told


def test_work_out_of_measure_is_refused_with_the_rows_that_it_would_make(tmp_path):
    rows = {"t": (0, 1, 199_998, 199_999), **{f"x{i}": np.ones(4) for i in range(100)}}
    path = write_csv(tmp_path / "a.csv", rows | {"u": (0, 1, 0, 1)})
    assert "an episode of 4 rows" in not_imported(path, *NAMED, "--rate", "100")
    table = pa.table({"t": [-(2**63), 0, 2**63 - 1], "x": [0.0, 1, 2], "u": [0.0, 1, 2]})
    pq.write_table(table, tmp_path / "d.parquet")
    assert "too far apart" in not_imported(tmp_path / "d.parquet", *NAMED)


def test_bags_without_metadata_and_columns_without_readings(tmp_path):
    path = write_bag(tmp_path / "walk", "mcap")
    (path / "metadata.yaml").unlink()
    names = ("--observations", "/joint_states.*.hip", "--actions", "/arm/command.data")
    assert "walk.mcap" in not_imported(path, *names, "--rate", "9")
    rows = {"t": TIMES, "x": TIMES, "gone": np.full(60, np.nan), "u": TIMES}
    told = not_imported(write_csv(tmp_path / "a.csv", rows), *NAMED, "--rate", "9")
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
    assert len(imported(tmp_path / odd, *NAMED)[1]) == 59


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

    assert "1,234" in not_imported(log("a.csv", "1,234"), *NAMED)
    _, data = imported(log("b.csv", "0,234"), *NAMED)
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
