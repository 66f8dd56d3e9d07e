"""Extending data sets: to the bytes of those collected at once, whatever happens in between."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from small import brief, contents, write_again

from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST, find_problems, read_manifest, write_manifest
from jbrep.errors import InputError


def two_by_two(steps, **changes):
    return brief(steps=steps, shard_episodes=2, **changes)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A shard of two episodes and one of one."""
    folder = tmp_path_factory.mktemp("short") / "data"
    collect(two_by_two(300), folder)
    return folder


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Two shards of two episodes and one of one, collected at once."""
    folder = tmp_path_factory.mktemp("long") / "data"
    collect(two_by_two(500), folder)
    return folder


class Kill(BaseException):
    """As sudden as an exception can be."""


def test_a_kill_at_any_moment_leaves_what_is_read_and_extended(short, long, tmp_path, monkeypatch):
    """Four files are written, each in three stages; full shards are there all the time."""
    before, left = Dataset(short), 0

    def deadly(call):
        def wrapped(*arguments, **keywords):
            nonlocal left
            left -= 1
            if left < 0:
                raise Kill
            return call(*arguments, **keywords)

        return wrapped

    for stage in range(12):
        folder, left = shutil.copytree(short, tmp_path / str(stage)), stage
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", deadly(os.fsync))
            patch.setattr(Path, "replace", deadly(Path.replace))
            with pytest.raises(Kill):
                write_again(long, folder)
        assert not list(find_problems(folder)), stage
        seen = Dataset(folder)["observation"][:200]
        np.testing.assert_array_equal(seen, before["observation"][:200])
        write_again(long, folder)
        assert contents(folder) == contents(long)


def test_what_can_t_be_extended_is_left_as_it_is(short, tmp_path):
    folder = shutil.copytree(short, tmp_path / "data")
    with pytest.raises(InputError, match="300 steps"):
        collect(two_by_two(200), folder)
    with pytest.raises(InputError, match=r"other settings: steps 300 \(now: 400\), seed 3"):
        collect(two_by_two(400, seed=4), folder)
    manifest = read_manifest(folder)
    changed = manifest.replace(versions={**manifest.versions, "mujoco": "3.0"})
    write_manifest(folder, changed)
    with pytest.raises(InputError, match=r"mujoco 3\.0"):
        collect(two_by_two(400), folder)
    assert read_manifest(folder) == changed
    now, before = contents(folder), contents(short)
    assert [name for name in now if now[name] != before[name]] == [MANIFEST]
