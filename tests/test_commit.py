"""The git commits that data sets, runs and encoders name, and what they don't change."""

import subprocess

import pytest
from small import contents, settings, write_again

from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import read_manifest, write_manifest
from jbrep.encoders import find, load, save
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.records import commit

HEAD = "0123456789" * 4


def git(folder, *arguments):
    own = ("-c", "user.name=a", "-c", "user.email=a@b")
    told = subprocess.run(["git", "-C", folder, *own, *arguments], check=True, capture_output=True)
    return told.stdout.decode().strip()


def test_a_commit_and_whether_files_differ_from_it(tmp_path, monkeypatch):
    folder = tmp_path / "work" / "deeper"
    folder.mkdir(parents=True)
    assert commit._commit(folder) == ""
    git(tmp_path, "init", "-q")
    assert commit._commit(folder) == ""  # nothing is committed
    (folder / "file").write_text("one")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    head = git(tmp_path, "rev-parse", "HEAD")
    (folder / "untracked").write_text("two")
    assert commit._commit(folder) == head
    (folder / "file").write_text("two")
    assert commit._commit(folder) == f"{head}+changes"
    installed = folder / "site-packages"
    installed.mkdir()
    assert commit._commit(installed) == ""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit._commit(folder) == ""  # without git


def test_a_manifest_says_the_commit_of_its_start_and_resumes_at_another(collected, tmp_path):
    assert read_manifest(collected).commits == dict(commit.commits())
    folder = tmp_path / "data"
    manifest = write_again(collected, folder).replace(commits={"jbrep": HEAD})
    write_manifest(folder, manifest.replace(shards=manifest.shards[:4]))
    collect(settings(), folder)
    assert read_manifest(folder) == manifest
    assert Dataset(folder).fingerprint == Dataset(collected).fingerprint
    shards = [name for name in contents(folder) if name.endswith(".h5")]
    assert all(contents(folder)[name] == contents(collected)[name] for name in shards)
    with pytest.raises(InputError, match="commits"):
        manifest.replace(commits={"jbrep": "main"})


def test_an_encoder_is_the_same_at_another_commit(tmp_path):
    encoder = find("dae-8", describe("face_direction"))
    other = encoder.with_header(commits={"work": HEAD})
    save(other, tmp_path / "it.safetensors")
    assert load(tmp_path / "it.safetensors").header.commits == {"work": HEAD}
    assert load(tmp_path / "it.safetensors").fingerprint == encoder.fingerprint
