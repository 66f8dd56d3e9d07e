"""Other tools open what is exported, with the same numbers in it."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from jbrep.dataset import Dataset
from jbrep.dataset.formats import FORMATS, export, open_sources
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS
from jbrep.records.storage import exclusive


@pytest.fixture(scope="module")
def dataset(collected):
    return Dataset(collected)


def test_npz(dataset, tmp_path):
    export(dataset, "npz", tmp_path / "new" / "data.npz")
    with np.load(tmp_path / "new" / "data.npz", allow_pickle=False) as archive:
        for name in dataset.columns:
            np.testing.assert_array_equal(archive[name], dataset[name])
            assert archive[name].dtype == dataset[name].dtype
        for name, values in dataset.episodes.items():
            np.testing.assert_array_equal(archive[f"episodes/{name}"], values)
        assert tuple(archive["feature_names"]) == TASKS["face_direction"].plain.feature_names
        assert archive["feature_units"][-1] == "rad"


def test_parquet(dataset, tmp_path):
    export(dataset, "parquet", tmp_path / "data.parquet")
    table = pq.read_table(tmp_path / "data.parquet")
    assert table.num_rows == 5000
    for name in (*TASKS["face_direction"].plain.feature_names, "reward", "episode", "step"):
        np.testing.assert_array_equal(table[name].to_numpy(), dataset[name])
    np.testing.assert_array_equal(table["action"].to_numpy(), dataset["action"][:, 0])
    np.testing.assert_array_equal(table["qvel_14"].to_numpy(), dataset["qvel"][:][:, 14])
    assert table.schema.field("velocity_x").metadata == {b"unit": b"m/s"}
    assert json.loads(table.schema.metadata[b"jbrep"])["seed"] == 3
    episodes = pq.read_table(tmp_path / "data-episodes.parquet")
    np.testing.assert_array_equal(episodes["return"].to_numpy(), dataset.episodes["return"])
    start = np.stack(episodes["initial_qpos"].to_numpy())
    np.testing.assert_array_equal(start, dataset.episodes["initial_qpos"])


MINARI = """
import sys
import numpy as np
import minari
(name,) = minari.list_local_datasets()
dataset = minari.load_dataset(name)
environment = dataset.recover_environment()
assert "jbrep" in sys.modules
assert dataset.total_episodes == 5 and dataset.total_steps == 5000
for episode, metadata in zip(
    dataset.iterate_episodes(), dataset.storage.get_episode_metadata(range(5)), strict=True
):
    observation, _ = environment.reset(seed=metadata["seed"])
    np.testing.assert_array_equal(observation, episode.observations[0])
    for step in range(1000 if episode.id == 4 else 3):
        observation, reward, terminated, truncated, _ = environment.step(episode.actions[step])
        np.testing.assert_array_equal(observation, episode.observations[step + 1])
        assert np.float32(reward) == episode.rewards[step]
        assert (terminated, truncated) == (episode.terminations[step], episode.truncations[step])
print(name, repr(dataset[0])[:11])
"""


def test_minari_lists_it_opens_it_and_recovers_the_environment(dataset, tmp_path, monkeypatch):
    """In a process that doesn't import jbrep itself; the environment repeats an episode."""
    monkeypatch.chdir(tmp_path)
    export(dataset, "minari", Path())
    assert "MINARI_DATASETS_PATH" not in os.environ
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", MINARI],
        env={**os.environ, "MINARI_DATASETS_PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "jitterbug/face_direction/uniform-v0 EpisodeData\n"


def test_a_table_belongs_to_the_file_of_its_episodes(dataset, tmp_path):
    path, beside = tmp_path / "data.parquet", tmp_path / "data-episodes.parquet"
    export(dataset, "parquet", path)
    content = beside.read_bytes()
    beside.unlink()
    with pytest.raises(InputError, match=r"data-episodes\.parquet is missing: it belongs to"):
        open_sources([str(path)])
    beside.write_bytes(content[:-1])
    with pytest.raises(InputError, match=r"data-episodes\.parquet can't be read"):
        open_sources([str(path)])
    path.unlink()
    with pytest.raises(InputError, match=r"data-episodes\.parquet exists already"):
        export(dataset, "parquet", path)
    assert not path.exists()


def test_an_exported_file_ends_as_its_format_does(dataset, tmp_path):
    wrong = [("npz", "face", "face"), ("npz", "face.parquet", "face.parquet"), ("npz", "/", "name")]
    for to, name, named in wrong:
        with pytest.raises(InputError, match=named):
            export(dataset, to, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_and_no_half_is_left(dataset, tmp_path, monkeypatch):
    for to in FORMATS:
        export(dataset, to, tmp_path / f"it.{to}")
        with pytest.raises(InputError, match="exists already"):
            export(dataset, to, tmp_path / f"it.{to}")

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jbrep.dataset.columns.Column.chunks", fail)
    monkeypatch.setattr("jbrep.dataset.columns.Column.__getitem__", fail)
    for to in FORMATS:
        with pytest.raises(InputError, match=r"can't write .*: No space left on device"):
            export(dataset, to, tmp_path / "new" / f"it.{to}")
    assert not [path.name for path in (tmp_path / "new").rglob("*") if path.is_file()]


def exported(to, folder):
    """What an export to it.FORMAT writes: its files, or the folder of its data set."""
    out = folder / f"it.{to}"
    return out / "jitterbug/face_direction/uniform-v0" if to == "minari" else out


KILLED = """
import os, sys
from pathlib import Path
from jbrep.dataset import Dataset
from jbrep.dataset.columns import Column
from jbrep.dataset.formats import export
for method in ("chunks", "__getitem__"):
    def die(*arguments, left=[3], call=getattr(Column, method)):
        left[0] -= 1
        if not left[0]:
            os.kill(os.getpid(), 9)
        return call(*arguments)
    setattr(Column, method, die)
export(Dataset(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
"""


@pytest.mark.parametrize("to", ["npz", "minari"])
def test_a_killed_export_leaves_nothing_under_the_final_name(to, dataset, tmp_path):
    out = tmp_path / f"it.{to}"
    command = [sys.executable, "-W", "ignore", "-c", KILLED, dataset.folder, to, out]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert not exported(to, tmp_path).exists()
    assert [path for path in tmp_path.rglob("*") if ".partial" in path.name]
    export(dataset, to, out)
    assert exported(to, tmp_path).exists()
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.parametrize("to", ["parquet", "lerobot"])
def test_an_export_is_on_the_disk_and_has_one_writer(to, dataset, tmp_path, monkeypatch):
    path, synced, sync = exported(to, tmp_path), set(), os.fsync

    def note(descriptor):
        synced.add(os.fstat(descriptor).st_ino)
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        exclusive(path, beside=True),
        pytest.raises(InputError, match="is being written by process"),
    ):
        export(dataset, to, tmp_path / f"it.{to}")
    assert not synced
    export(dataset, to, tmp_path / f"it.{to}")
    for written in (path.parent, path, *path.rglob("*")):
        assert written.stat().st_ino in synced, written
