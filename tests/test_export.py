"""Other tools open what is exported, with the same numbers in it."""

import json
import os
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest

from jbrep.dataset import Dataset
from jbrep.dataset.export import FORMATS, export
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS


@pytest.fixture(scope="module")
def dataset(collected):
    return Dataset(collected)


def test_npz(dataset, tmp_path):
    assert "numpy.load(" in export(dataset, "npz", tmp_path / "new" / "data.npz")
    with np.load(tmp_path / "new" / "data.npz", allow_pickle=False) as archive:
        for name in dataset.columns:
            np.testing.assert_array_equal(archive[name], dataset[name])
            assert archive[name].dtype == dataset[name].dtype
        for name, values in dataset.episodes.items():
            np.testing.assert_array_equal(archive[f"episodes/{name}"], values)
        assert archive["feature_names"].tolist() == list(TASKS["face_direction"].feature_names)
        assert archive["feature_units"][-1] == "rad"


def test_parquet(dataset, tmp_path):
    assert "pandas.read_parquet(" in export(dataset, "parquet", tmp_path / "data.parquet")
    table = pq.read_table(tmp_path / "data.parquet")
    assert table.num_rows == 5000
    for name in (*TASKS["face_direction"].feature_names, "reward", "episode", "step"):
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


def test_minari_lists_it_opens_it_and_recovers_the_environment(dataset, tmp_path):
    """In a process that doesn't import jbrep itself; the environment repeats an episode."""
    told = export(dataset, "minari", tmp_path)
    assert f"MINARI_DATASETS_PATH={tmp_path}" in told
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


def test_parquet_files_come_together_or_not_at_all(dataset, tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError("the disk is gone")

    monkeypatch.setattr(pq, "write_table", fail)
    with pytest.raises(InputError, match=r"can't write .*data\.parquet: the disk is gone"):
        export(dataset, "parquet", tmp_path / "data.parquet")
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten_and_no_half_is_left(dataset, tmp_path, monkeypatch):
    for to in FORMATS:
        export(dataset, to, tmp_path / to)
        with pytest.raises(InputError, match="exists already"):
            export(dataset, to, tmp_path / to)
    with pytest.raises(InputError, match="unknown format 'csv': choose one of minari, parquet"):
        export(dataset, "csv", tmp_path / "x")

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jbrep.dataset.columns.Column.chunks", fail)
    monkeypatch.setattr("jbrep.dataset.columns.Column.__getitem__", fail)
    for to in FORMATS:
        with pytest.raises(InputError, match=r"can't write .*: No space left on device"):
            export(dataset, to, tmp_path / "new" / to)
    left = [path.name for path in (tmp_path / "new").rglob("*") if path.is_file()]
    assert set(left) == {"namespace_metadata.json"}  # Minari's, beside its data sets
