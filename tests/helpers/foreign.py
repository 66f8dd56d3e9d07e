"""Files as other tools write them: logs, bags, data sets of LeRobot, D4RL and robomimic."""

import json

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from command import jbrep, mistake
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from jbrep.dataset import Dataset
from jbrep.dataset.manifest import find_problems

RATE = 100
TIMES = np.concatenate((np.arange(60), 500 + np.arange(60))) / RATE
TICKS = 420_000_000 + np.arange(120)
GYRO = 8 + np.arange(120) / 100
PITCH = (800 * TIMES + 180) % 360 - 180
VOLTS = np.sin(np.arange(120))
STEPS = np.concatenate([np.arange(n) for n in (10, 8, 7)])
ROWS = len(STEPS)


def imported(path, *options, out="data"):
    """What the command says, and the data set."""
    folder = path.parent / out
    done = jbrep("data", "import", path, *options, "--out", folder)
    assert done.exit_code == 0, done.output
    assert not list(find_problems(folder))
    return done.output, Dataset(folder)


def not_imported(path, *options):
    """The line with which an import is refused; it leaves nothing."""
    there = {*path.parent.iterdir()}
    told = mistake("data", "import", path, *options, "--out", path.parent / "no")
    assert {*path.parent.iterdir()} == there
    return told


def csv_rows(**changes):
    """A log's cells; some of a column may be replaced."""
    columns = {
        "time [s]": [f"{t:.5f}" for t in TIMES],
        "pitch [deg]": [f"{v:.4f}" for v in PITCH],
        "gyro (rad/s)": [f"{v:.3f}" for v in GYRO],
        "ticks": [str(v) for v in TICKS],
        "u [V]": [f"{v:.4f}" for v in VOLTS],
        "status": ["OK"] * 120,
    }
    for name, cells in changes.items():
        for row, cell in cells.items():
            columns[next(n for n in columns if n.startswith(name))][row] = cell
    return columns


def write_csv(path, rows, separator=",", before=(), decimal="."):
    cells = (map(str, row) for row in zip(*rows.values(), strict=True))
    lines = [separator.join(rows), *map(separator.join, cells)]
    lines[1:] = [line.replace(".", decimal) for line in lines[1:]]
    path.write_text("\n".join([*before, *lines]) + "\n", encoding="utf-8-sig")
    return path


def lerobot_folder(folder, version="v3.0", **features):
    """A data set as LeRobot's documentation lays it out: three episodes, a camera."""
    lengths = (10, 11, 12)
    step = np.concatenate([np.arange(n) for n in lengths])
    state = np.stack([np.repeat(range(3), lengths), step], axis=1).astype(np.float32)
    names = {"motors": ["shoulder.pos", "elbow.pos"]}
    known = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": names},
        "action": {"dtype": "float32", "shape": [2], "names": names},
        "observation.images.top": {"dtype": "video", "shape": [3, 48, 64], "names": None},
        "next.reward": {"dtype": "float32", "shape": [1], "names": None},
        **features,
    }
    columns = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32(), 2)),
        "action": pa.array((state / 12).tolist(), pa.list_(pa.float32())),
        "next.reward": pa.array(step.astype(np.float32)),
        "timestamp": pa.array((step / 30).astype(np.float32)),
        "frame_index": pa.array(step),
        "episode_index": pa.array(np.repeat(range(3), lengths)),
        "index": pa.array(np.arange(33)),
        "task_index": pa.array(np.zeros(33, int)),
    }
    info = {"codebase_version": version, "fps": 30, "features": known}
    return write_lerobot(folder, columns, 21, info)


def write_lerobot(folder, columns, cut, info):
    """A folder of LeRobot whose rows are in two files, or in one."""
    table = pa.table(columns)
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    for file, (begin, rows) in enumerate([(0, cut), (cut, len(table) - cut)]):
        path = folder / f"data/chunk-000/file-{file:03d}.parquet"
        if rows:
            pq.write_table(table.slice(begin, rows), path)
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


def open_bag(path, kind):
    """A bag's types, its writer, and what packs a message."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":
        writer, pack = Writer1(path), store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer, pack = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    return store, writer, pack


def write_bag(path, kind, silent=(), joints=("hip", "knee"), count=0, compressed=()):
    """Joints at 100 Hz in changing order, commands at 10 Hz that pause, a count, and words.

    Messages of silent joints, by their numbers, have none.
    """
    store, writer, pack = open_bag(path, kind)
    if compressed:
        writer.set_compression(*compressed)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    first = {"seq": 0} if kind == "bag" else {}
    header = types["std_msgs/msg/Header"](**first, stamp=stamp, frame_id="base")
    empty = np.zeros(0)
    with writer:
        made = {
            topic: writer.add_connection(topic, f"{name}", typestore=store)
            for topic, name in {
                "/joint_states": "sensor_msgs/msg/JointState",
                "/arm/command": "std_msgs/msg/Float64",
                "/count": "std_msgs/msg/Int64",
                "/rosout": "std_msgs/msg/String",
            }.items()
        }
        for i in range(300):
            time = 1_700_000_000_000_000_000 + i * 10_000_000
            names, angles = [*joints], np.array([i / 100, -i / 100])
            if i % 2:
                names, angles = names[::-1], angles[::-1].copy()
            if i in silent:
                names, angles = [], empty
            state = types["sensor_msgs/msg/JointState"](header, names, angles, empty, empty)
            writer.write(made["/joint_states"], time, pack(state, state.__msgtype__))
            ticks = types["std_msgs/msg/Int64"](count + i)
            writer.write(made["/count"], time, pack(ticks, ticks.__msgtype__))
            if i % 10 == 5 and not 100 < i < 200:
                command = types["std_msgs/msg/Float64"](float(i))
                writer.write(made["/arm/command"], time, pack(command, command.__msgtype__))
        word = types["std_msgs/msg/String"]("hello")
        writer.write(made["/rosout"], time, pack(word, word.__msgtype__))
    return path


def write_d4rl(path, **changes):
    """Three episodes: a terminal, a timeout and one that is cut off; as hopper-medium-v2 has it."""
    random = np.random.default_rng(0)
    arrays = {
        "observations": np.stack([STEPS, np.repeat(range(3), (10, 8, 7))], 1).astype(np.float32),
        "actions": random.uniform(-1, 1, (ROWS, 3)).astype(np.float32),
        "rewards": STEPS.astype(np.float32)[:, None],
        "terminals": np.arange(ROWS) == 9,
        "timeouts": np.arange(ROWS) == 17,
        "infos/qpos": random.normal(size=(ROWS, 4)),
        "metadata/policy/fc0/weight": random.normal(size=(5, 5)),
        "metadata/algorithm": np.bytes_("SAC"),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            if values is not None:
                compression = {"compression": "gzip"} if np.ndim(values) else {}
                file.create_dataset(name, data=values, **compression)
    return path


def write_robomimic(path, counts=(6, 5, 4, *[3] * 8), damage=lambda data: None):
    """Demos of a robosuite task as dataset_states_to_obs.py writes them, with a camera."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for number, count in enumerate(counts):
            demo, states = data.create_group(f"demo_{number}"), np.arange(count + 1)
            seen = {
                "object": np.stack([states, states**2, 0 * states + number], 1) / 8,
                "robot0_eef_pos": states[:, None] * [0.1, 0.2],
                "robot0_gripper": states / 1.0,
                "agentview_image": np.zeros((count + 1, 4, 4, 3), np.uint8),
            }
            for name, values in seen.items():
                demo[f"obs/{name}"], demo[f"next_obs/{name}"] = values[:-1], values[1:]
            demo["actions"] = np.random.default_rng(number).uniform(-1, 1, (count, 7))
            demo["actions_abs"] = np.asarray(demo["actions"]) * 2
            demo["states"] = np.zeros((count, 9))
            demo["rewards"] = (states[1:] == count) * 1.0
            demo["dones"] = (states[1:] >= count - (number == 1)).astype(int)
            demo.attrs["num_samples"], demo.attrs["model_file"] = count, "<mujoco/>"
        data.attrs["total"] = sum(counts)
        told = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20}}
        data.attrs["env_args"] = json.dumps(told)
        file["mask/train"] = np.array([b"demo_0"])
        damage(data)
    return path
