"""Data sets of the first release: read, verified, repaired and exported as they are."""

import platform
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from command import jbrep
from small import contents, settings

from jbrep.collect import collect
from jbrep.collect.derive import derive
from jbrep.collect.policies import Uniform
from jbrep.collect.repair import repair
from jbrep.collect.replay import replay_problems
from jbrep.collect.shards import simulate_shard
from jbrep.dataset import Dataset, version1
from jbrep.dataset.export import export
from jbrep.dataset.manifest import (
    BACKUP,
    MANIFEST,
    Manifest,
    commit,
    new_manifest,
    read_manifest,
    write_manifest,
)
from jbrep.dataset.verify import find_problems
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS

RELEASED = Path(__file__).parent / "version1"  # what 0.1.0 wrote of two episodes, less its shards
ENDS = {f"episodes/{name}" for name in ("diverged", "terminated", "truncated")}

pytestmark = pytest.mark.skipif(
    platform.machine() != "x86_64"
    or read_manifest(RELEASED).versions["mujoco"] != version("mujoco"),
    reason="the physics rounds otherwise here",
)


@pytest.fixture(scope="module")
def released(tmp_path_factory):
    """The data set that 0.1.0 wrote: its shards are made again, which checks every column."""
    folder = tmp_path_factory.mktemp("released") / "data"
    shutil.copytree(RELEASED, folder)
    told = [line.rpartition("/")[2] for line in repair(folder)]
    assert told[:2] == ["shard-00000.h5 restored", "shard-00001.h5 restored"]
    return folder


def test_columns_are_those_of_the_first_release(released, collected):
    """The same seed, the same bytes; only how an episode ended is told otherwise."""
    for before, now in zip(
        read_manifest(released).shards, read_manifest(collected).shards, strict=False
    ):
        both = before.sha256.keys() & now.sha256.keys()
        assert before.sha256.keys() ^ now.sha256.keys() == ENDS
        assert {name: before.sha256[name] for name in both} == {n: now.sha256[n] for n in both}


def test_a_data_set_of_the_first_release_is_read_and_verified(released, collected):
    dataset, now = Dataset(released), Dataset(collected)
    assert dataset.manifest.complete
    assert dataset.task == now.task
    for name in now.columns:
        np.testing.assert_array_equal(dataset[name], now[name][:2000])
    for name, values in now.episodes.items():
        np.testing.assert_array_equal(dataset.episodes[name], values[:2])
    told = jbrep("data", "verify", released, "--replay", 2)
    assert "2 episodes simulated again: equal in every bit" in told.output, told.output
    assert "2 of 1,000 steps" in jbrep("data", "info", released).output
    derive(released, "face_direction", released.parent / "derived")
    np.testing.assert_array_equal(
        Dataset(released.parent / "derived")["observation"], dataset["observation"]
    )


def test_an_unfinished_one_is_not_resumed_in_another_format(released, tmp_path):
    folder = shutil.copytree(released, tmp_path / "data")
    manifest = read_manifest(folder)
    write_manifest(folder, Manifest(**{**vars(manifest), "shards": manifest.shards[:1]}))
    (folder / "shard-00001.h5").unlink()
    before = contents(folder)
    with pytest.raises(InputError, match=r"started with other versions: .*format 1 \(now: 2\)"):
        collect(settings(steps=2000), folder)
    assert contents(folder) == before
    assert collect(settings(steps=2000), released).rows == 0


@pytest.mark.usefixtures("diverging")
def test_an_episode_that_diverged_lacks_its_last_row(tmp_path):
    """The second one in its 31st step, the third in its first."""
    some, folder = settings(steps=3000), tmp_path / "data"
    now = new_manifest(some)
    manifest = Manifest(now.settings, now.versions, format_version=1)
    folder.mkdir()
    for shard in range(3):
        columns = version1.columns(simulate_shard(some, Uniform(), shard, lambda steps: None))
        manifest = commit(folder, manifest, columns)
    dataset = Dataset(folder)
    assert dataset.manifest == manifest
    assert dataset.manifest.complete
    assert len(dataset) == 1030
    np.testing.assert_array_equal(dataset.episodes["length"], [1000, 30, 0])
    np.testing.assert_array_equal(dataset.episodes["truncated"], 1)
    assert not list(find_problems(folder))
    assert not list(replay_problems(dataset, 3))
    before = contents(folder)
    for name in ("shard-00001.h5", "shard-00002.h5", MANIFEST):
        (folder / name).unlink()
    assert len(list(repair(folder, lanes=3))) == 3
    assert contents(folder) == before
    (folder / BACKUP).unlink()
    assert len(list(repair(folder))) == 1
    assert contents(folder) == before
    for to in ("npz", "parquet", "minari"):
        export(Dataset(folder), to, tmp_path / to)
    with np.load(tmp_path / "npz") as archive:
        np.testing.assert_array_equal(archive["episodes/length"], [1000, 30, 0])
        assert len(archive["observation"]) == 1030


@pytest.mark.parametrize("task", TASKS)
def test_the_first_release_s_samples_are_verified(task):
    told = jbrep("data", "verify", f"data/sample/{task}", "--replay", 1)
    assert (told.exit_code, "no problems in 4,000 rows, 1 shard" in told.output) == (0, True)
