"""Damage is found before a row is returned, and the file is named."""

import os
import shutil

import numpy as np
import pytest
from small import flip_bit, write_again

from jbrep.dataset import DamageError, Dataset, reader
from jbrep.dataset.manifest import MANIFEST, find_problems, open_shard
from jbrep.errors import InputError


def read_all(folder):
    """Every number of a data set."""
    dataset = Dataset(folder)
    return [dataset[name][:] for name in dataset.columns], dataset.episodes


def flip(random, files):
    path = random.choice(files)
    flip_bit(path, random.integers(8 * path.stat().st_size))
    return [path]


def truncate(random, files):
    path = random.choice(files)
    os.truncate(path, random.integers(path.stat().st_size))
    return [path]


def remove(random, files):
    path = random.choice(files)
    path.unlink()
    return [path]


def swap(random, files):
    one, other = random.choice(files, 2, replace=False)
    aside = one.with_suffix(".aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    return [one, other]


DAMAGES = (flip, flip, truncate, remove, swap)


def test_no_random_damage_is_missed(brief, tmp_path):
    copied = shutil.copytree(brief, tmp_path / "copied")
    random = np.random.default_rng(0)
    whole = {path: path.read_bytes() for path in sorted(copied.glob("*.h5"))}
    for trial in range(60):
        touched = DAMAGES[trial % len(DAMAGES)](random, np.array([*whole]))
        with pytest.raises(DamageError) as found:
            read_all(copied)
        assert any(path.name in str(found.value) for path in touched), touched
        problems = list(find_problems(copied))
        assert len(problems) == len(touched)
        assert all(any(path.name in line for line in problems) for path in touched)
        for path, content in whole.items():
            path.write_bytes(content)
    read_all(copied)


@pytest.mark.parametrize("damage", [flip, truncate])
def test_a_damaged_manifest_is_named(damage, copied):
    random, path = np.random.default_rng(0), copied / MANIFEST
    whole = path.read_bytes()
    for _ in range(10):
        damage(random, [path])
        with pytest.raises(InputError, match=r"manifest\.json"):
            Dataset(copied)
        path.write_bytes(whole)


def test_rows_of_a_damaged_shard_are_not_returned_but_others_are(copied):
    flip_bit(copied / "shard-00003.h5", -40)
    dataset = Dataset(copied)
    assert dataset["reward"][2999].shape == ()
    for rows in (3000, slice(2999, 3001), [0, 3999]):
        with pytest.raises(DamageError, match=r"shard-00003\.h5"):
            dataset["observation"][rows]


def test_a_shard_is_read_through_once_however_often_it_is_opened(copied, monkeypatch):
    """Another size is noticed each time."""
    opened = []

    def count(folder, manifest, shard, *, known=False):
        opened.append(known)
        return open_shard(folder, manifest, shard, known=known)

    monkeypatch.setattr(reader, "open_shard", count)
    monkeypatch.setattr(reader, "_OPEN_SHARDS", 2)
    data = Dataset(copied)
    for _ in range(3):
        data["reward"][::500]
    assert (opened.count(False), opened.count(True)) == (5, 15)
    os.truncate(copied / "shard-00000.h5", 1000)
    with pytest.raises(DamageError, match=r"shard-00000\.h5"):
        data["reward"][0]


def test_files_that_can_t_be_read_are_named(copied):
    path = copied / "shard-00000.h5"
    content = path.read_bytes()
    path.unlink()
    with pytest.raises(DamageError, match=r"shard-00000\.h5 is missing"):
        Dataset(copied)
    path.write_bytes(content)
    dataset = Dataset(copied)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"shard-00000\.h5"):
        dataset["reward"][0]


def test_shards_without_a_manifest_are_no_data_set(copied, collected):
    (copied / MANIFEST).unlink()
    for use in (Dataset, lambda folder: list(find_problems(folder))):
        with pytest.raises(InputError, match=f"no data set in .*{MANIFEST}"):
            use(copied)
    with pytest.raises(InputError, match=f"has shards but no {MANIFEST}"):
        write_again(collected, copied)
