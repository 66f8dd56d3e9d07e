"""Damage, and files that mean harm: found before a row is returned, and named."""

import json
import os
import re
import shutil
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
from small import flip_bit, write_again

from jbrep.collect.derive import derive
from jbrep.collect.repair import repair
from jbrep.dataset import DamageError, Dataset
from jbrep.dataset.formats import export
from jbrep.dataset.manifest import MANIFEST, read_manifest, shard_name, write_manifest
from jbrep.dataset.shard import column_hashes, file_hash, shard_image
from jbrep.dataset.verify import find_problems
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


def append(random, files):
    path = random.choice(files)
    path.write_bytes(path.read_bytes() + random.bytes(random.integers(1, 100)))
    return [path]


def remove(random, files):
    path = random.choice(files)
    path.unlink()
    return [path]


def swap(random, files):
    one, other = random.choice(files[:-1], 2, replace=False)  # the last is the manifest
    aside = one.with_suffix(".aside")
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    return [one, other]


def duplicate(random, files):
    one, other = random.choice(files[:-1], 2, replace=False)
    target = random.choice([other, one.with_name("shard-00005.h5"), one.with_name("copy.h5")])
    shutil.copy(one, target)
    return [target]


def rename(random, files):
    path = random.choice(files)
    target = path.with_name(str(random.choice(["shard-00005.h5", "shard-00012.h5", "old.h5"])))
    path.rename(target)
    return [path, target]


def scramble(random, files):
    """A stretch of random bytes, or of zeros as a disk that lost a page leaves it."""
    path = random.choice(files)
    content = bytearray(path.read_bytes())
    start = random.integers(len(content))
    length = len(content[start : start + 512])
    noise = random.bytes(length) if random.random() < 0.5 else bytes(length)
    content[start : start + length] = noise
    changed = bytes(content) != path.read_bytes()
    path.write_bytes(content)
    return [path] if changed else flip(random, files)


DAMAGES = (flip, flip, flip, truncate, append, remove, swap, duplicate, rename, scramble)


@pytest.mark.parametrize("seed", range(4))
def test_none_of_200_random_damages_is_missed(seed, brief, tmp_path):
    copied = shutil.copytree(brief, tmp_path / "copied")
    random = np.random.default_rng(seed)
    files = [*sorted(copied.glob("*.h5")), copied / MANIFEST]
    whole = {path: path.read_bytes() for path in files}
    for trial in range(50):
        damage = DAMAGES[trial % len(DAMAGES)]
        touched = damage(random, np.array(files))
        with pytest.raises(DamageError) as found:
            read_all(copied)
        assert any(path.name in str(found.value) for path in touched), (damage, touched)
        assert "\n" not in str(found.value)
        problems = list(find_problems(copied))
        assert any(path.name in problem for path in touched for problem in problems)
        for path in {*copied.glob("*.h5"), copied / MANIFEST} - set(files):
            path.unlink()
        for path, content in whole.items():
            path.write_bytes(content)
    read_all(copied)


def test_every_bit_of_the_small_parts_counts(brief, tmp_path):
    """All bits of the manifest's and a shard's first bytes, where HDF5's own structure is."""
    copied = shutil.copytree(brief, tmp_path / "copied")
    for path, end in ((copied / MANIFEST, 200), (copied / "shard-00000.h5", 128)):
        for bit in range(8 * end):
            flip_bit(path, bit)
            with pytest.raises(DamageError, match=path.name):
                Dataset(copied)["reward"][0]
            flip_bit(path, bit)


def test_rows_of_a_damaged_shard_are_not_returned_but_others_are(copied):
    flip_bit(copied / "shard-00003.h5", -40)
    dataset = Dataset(copied)
    assert dataset["reward"][2999].shape == ()
    for rows in (3000, slice(2999, 3001), [0, 3999]):
        with pytest.raises(DamageError, match=r"shard-00003\.h5 is damaged"):
            dataset["observation"][rows]


@pytest.mark.parametrize("damage", [truncate, flip, remove])
def test_a_shard_that_changes_while_it_is_open_is_checked_again(damage, copied):
    """Reading a memory map of a file that has become shorter would end the process."""
    dataset = Dataset(copied)
    read_all(copied)
    dataset["reward"][:]
    batches = dataset.batches(size=1000, memory=1000)
    damage(np.random.default_rng(0), [copied / "shard-00003.h5"])
    assert dataset["reward"][2999].shape == ()
    for use in (
        lambda: dataset["reward"][3000],
        lambda: list(dataset["velocity"].chunks()),
        lambda: list(batches),
    ):
        with pytest.raises(DamageError, match=r"shard-00003\.h5 is (damaged|missing)"):
            use()


def test_a_shard_in_the_place_of_another_is_not_read(copied):
    """Its bytes were checked, as those of the other."""
    dataset = Dataset(copied)
    dataset["reward"][:1000]
    path = copied / "shard-00001.h5"
    path.unlink()
    os.link(copied / "shard-00000.h5", path)
    with pytest.raises(DamageError, match=r"shard-00001\.h5 is damaged"):
        dataset["reward"][1000]


def test_a_shard_that_is_repaired_while_it_is_open_is_read_on(copied):
    dataset = Dataset(copied)
    rewards = dataset["reward"][:]
    path = copied / "shard-00003.h5"
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content)
    np.testing.assert_array_equal(dataset["reward"], rewards)


def test_a_file_that_is_left_over_or_not_a_shard_is_named(copied, collected):
    (copied / "notes.txt").write_text("collected on a Tuesday")
    (copied / "manifest.json.partial").write_text("{")
    read_all(copied)
    write_manifest(copied, read_manifest(copied).replace(shards=()))
    with pytest.raises(DamageError, match=r"shard-00001\.h5 is not one of the 0 shards"):
        Dataset(copied)


def of(*place, **changes):
    """Change what stands at a place of a manifest."""

    def change(record):
        for step in place:
            record = record[step]
        record.update(changes)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (of(format_version=1), "has version 1 of the jbrep data set format: this jbrep reads"),
        (of(format_version=2), "has version 2 of the jbrep data set format: this jbrep reads"),
        (of(format_version=0), "has version 0"),
        (of(format="other"), "is damaged"),
        (of(shards={}), "is damaged"),
        (of(shards=[[]]), "is damaged"),
        (of(versions=[]), "is damaged"),
        (lambda record: record["settings"].pop("seed"), "is damaged: it isn't what jbrep wrote"),
        (of("settings", task="fly"), "is damaged: it isn't what jbrep wrote"),
        (of("settings", steps=-1), "is damaged"),
        (of("settings", "environment", id="os:system"), "is damaged"),
        (of("settings", "environment", arguments={"g": float("nan")}), "is damaged"),
        (
            of("settings", "environment", state={"length": 1}),
            "has an array 'length': data sets have such a col",
        ),
        (of("settings", "environment", seed_bits=31, draws=1 << 40), "is damaged"),
        (of("settings", more=1), "is damaged"),
        (of("settings", policy={"kind": "../../up"}), "is damaged"),
        (of("settings", policy={"kind": "constant", "drive": 10**400}), "is damaged"),
        (of("settings", policy={"kind": "constant", "drive": "\x1b[2J"}), "is damaged"),
        (of("settings", policy={"kind": "imported", "parts": [[[[[[1]]]]]]}), "is damaged"),
        (of(versions={"jbrep": "1"}), "is damaged"),
        (of("versions", jbrep="\x1b[2J"), "is damaged"),
        (of("versions", jbrep="\ud800"), "is damaged"),
        (of("shards", 0, rows=-1), "is damaged"),
        (of("shards", 0, rows=1001), "is damaged"),
        (of("shards", 0, episodes=0), "is damaged"),
        (of("shards", 0, episodes=2), "is damaged"),
        (of("shards", 0, rows=999), "has shape"),
        (of("shards", 0, bytes=10**15), "has"),
        (of("shards", 0, sha256=[]), "is damaged"),
        (of("shards", 0, sha256={}), "is damaged"),
        (of("shards", 0, path="/etc/passwd"), "is damaged"),
    ],
)
def test_a_manifest_that_means_harm(change, message, copied):
    """Its own hash is right: a stranger can work it out."""
    from jbrep.dataset import manifest

    record = json.loads((copied / MANIFEST).read_bytes())
    change(record)
    (copied / MANIFEST).write_text(manifest._hashed(record))
    with pytest.raises(InputError, match=message):
        read_all(copied)


def test_files_that_can_t_be_read_are_named(copied, monkeypatch):
    dataset = Dataset(copied)

    def refuse(path, *arguments, opened=Path.open, **keywords):
        if str(path).startswith(str(copied)):
            raise PermissionError(13, "Permission denied")
        return opened(path, *arguments, **keywords)

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match=r"can't read .*shard-00000\.h5: Permission denied"):
        dataset["reward"][0]
    with pytest.raises(InputError, match=r"can't read .*manifest\.json: Permission denied"):
        Dataset(copied)


def external_storage(file, fifo):
    del file["reward"]
    file.create_dataset("reward", (1000,), "<f4", external=[(str(fifo), 0, 4000)])


def external_link(file, fifo):
    del file["reward"]
    file["reward"] = h5py.ExternalLink(str(fifo), "reward")


def soft_link(file, fifo):
    file.move("reward", "elsewhere")
    file["reward"] = h5py.SoftLink("/elsewhere")


def soft_link_of_the_same_count(file, fifo):
    del file["reward"]
    file["reward"] = h5py.SoftLink("/step")


def virtual(file, fifo):
    del file["reward"]
    layout = h5py.VirtualLayout((1000,), "<f4")
    layout[:] = h5py.VirtualSource(str(fifo), "reward", (1000,))
    file.create_virtual_dataset("reward", layout)


def virtual_without_end(file, fifo):
    del file["reward"]
    layout = h5py.VirtualLayout((1000,), "<f4", maxshape=(None,))
    source = h5py.VirtualSource(str(fifo), "reward", (1000,), maxshape=(None,))
    layout[0 : h5py.h5s.UNLIMITED] = source[0 : h5py.h5s.UNLIMITED]
    file.create_virtual_dataset("reward", layout)


def linked_group(file, fifo):
    del file["episodes"]
    file["episodes"] = h5py.ExternalLink(str(fifo), "/")


def huge(file, fifo):
    del file["reward"]
    file.create_dataset("reward", (1 << 50,), "<f4", chunks=(1 << 20,))


def never_written(file, fifo):
    del file["reward"]
    space = h5py.h5s.create_simple((1000,))
    h5py.h5d.create(file.id, b"reward", h5py.h5t.IEEE_F32LE, space)


def compressed(file, fifo):
    del file["reward"]
    file.create_dataset("reward", data=np.zeros(1000, "<f4"), compression="gzip")


def unknown_filter(file, fifo):
    del file["reward"]
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((100,))
    properties.set_filter(h5py.h5z.FILTER_SZIP + 60_000, h5py.h5z.FLAG_OPTIONAL, (1, 2))
    space = h5py.h5s.create_simple((1000,))
    h5py.h5d.create(file.id, b"reward", h5py.h5t.IEEE_F32LE, space, properties)


def another_type(file, fifo):
    del file["reward"]
    file["reward"] = np.zeros(1000)


def text(file, fifo):
    del file["reward"]
    file["reward"] = ["pickle"] * 1000


def group(file, fifo):
    del file["reward"]
    file.create_group("reward")


def column_for_group(file, fifo):
    del file["episodes"]
    file["episodes"] = np.zeros(11)


def more(file, fifo):
    file["more"] = np.zeros(3)


HARMS = (
    external_storage,
    external_link,
    soft_link,
    soft_link_of_the_same_count,
    virtual,
    virtual_without_end,
    linked_group,
    huge,
    never_written,
    compressed,
    unknown_filter,
    another_type,
    text,
    group,
    column_for_group,
    more,
)


@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_a_shard_that_means_harm(harm, copied, tmp_path):
    """Its hashes are right. Whoever opened the other file, a pipe that nobody fills, would hang."""
    fifo = tmp_path / "pipe"
    os.mkfifo(fifo)
    path = copied / "shard-00000.h5"
    with h5py.File(path, "r+") as file:
        harm(file, fifo)
    adopt(copied, path)
    errors = []

    def read():
        try:
            read_all(copied)
        except DamageError as error:
            errors.append(str(error))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(timeout=30)
    assert not thread.is_alive()
    assert len(errors) == 1
    assert path.name in errors[0]
    assert errors[0] in list(find_problems(copied))


def adopt(folder, path):
    """Make the manifest name a changed first shard."""
    content, manifest = path.read_bytes(), read_manifest(folder)
    first = manifest.shards[0]
    entry = first.replace(bytes=len(content), xxh3=file_hash(content))
    write_manifest(folder, manifest.replace(shards=(entry, *manifest.shards[1:])))


@pytest.mark.parametrize("length", [2**31 - 1, -5, 10, 1500])
def test_lengths_that_rows_can_t_be_found_by_are_refused(length, copied, tmp_path):
    forge(copied, spoil("episodes/length", 0, length))
    for use in (
        lambda: Dataset(copied).split(),
        lambda: export(Dataset(copied), "minari", tmp_path / "minari"),
        lambda: derive(copied, "move_to_pose", tmp_path / "derived"),
    ):
        with pytest.raises(DamageError, match=r"00000\.h5 is damaged: the lengths of its episodes"):
            use()


def test_a_backup_of_nothing_calls_for_collecting_again(collected, tmp_path):
    """As a collector leaves it that is killed before its first manifest is there."""
    write_manifest(tmp_path, read_manifest(collected).replace(shards=()))
    (tmp_path / MANIFEST).unlink()
    for use in (Dataset, lambda folder: list(find_problems(folder)), lambda f: list(repair(f))):
        with pytest.raises(InputError, match="run the same jbrep collect again"):
            use(tmp_path)
    write_again(collected, tmp_path)
    assert not list(find_problems(tmp_path))


def test_shards_without_any_manifest_are_called_so(copied):
    for name in (MANIFEST, "manifest.backup.json"):
        (copied / name).unlink()
    message = r"has 5 HDF5 files but neither manifest\.json nor manifest\.backup\.json, without"
    with pytest.raises(DamageError, match=message):
        Dataset(copied)
    assert [re.search(message, problem) is not None for problem in find_problems(copied)] == [True]
    with pytest.raises(DamageError, match="collect again in another folder"):
        list(repair(copied))


def test_the_backup_of_the_manifest_is_looked_after(copied, collected):
    backup = copied / "manifest.backup.json"
    for spoiling in (backup.unlink, lambda: backup.write_bytes(b"{}")):
        spoiling()
        (problem,) = find_problems(copied)
        assert "manifest.backup.json" in problem
        read_all(copied)
        assert len(list(repair(copied))) == 1
        assert backup.read_bytes() == (copied / MANIFEST).read_bytes()
    write_manifest(copied, read_manifest(collected).replace(shards=()))
    shutil.copy(collected / MANIFEST, copied)
    (problem,) = find_problems(copied)
    assert "manifest.backup.json is of another data set" in problem


def forge(folder, change):
    """Write the first shard as a collector with a fault would, hashes and all."""
    manifest = read_manifest(folder)
    with h5py.File(folder / shard_name(0)) as file:
        columns = {name: file[name][:] for name in manifest.settings.specs()}
    change(columns)
    hashes = column_hashes(columns)
    image = shard_image(columns, hashes, manifest.attributes(0, 1000))
    (folder / shard_name(0)).write_bytes(image)
    entry = manifest.shards[0].replace(bytes=len(image), xxh3=file_hash(image), sha256=hashes)
    write_manifest(folder, manifest.replace(shards=(entry, *manifest.shards[1:])))


def spoil(name, place, value):
    def change(columns):
        columns[name] = columns[name].copy()
        columns[name][place] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (spoil("observation", (3, 2), np.nan), "observation has values that are not finite"),
        (spoil("qvel", (3, 2), np.inf), "qvel has values that are not finite"),
        (spoil("action", 5, 1.5), r"action 0 ranges from .* to 1.5, beyond \[-1, 1\]"),
        (spoil("reward", 5, -0.5), r"reward ranges from -0.5"),
        (spoil("observation", (5, 13), 4), "motor_angle ranges from"),
        (spoil("observation", (5, 3), 2), "orientation_w ranges from"),
        (spoil("episodes/final_observation", (0, 15), 9), "angle_to_target ranges from"),
        (spoil("episode", 5, 1), ": episode: inconsistent with"),
        (spoil("step", 5, 6), ": step: inconsistent with"),
        (spoil("reward", 5, 0.123), "episodes/return: inconsistent with"),
        (spoil("episodes/seed", 0, 5), "episodes/seed: inconsistent with"),
        (spoil("episodes/length", 0, 999), "lengths of its episodes don't add up to 1,000 rows"),
        (spoil("episodes/length", 0, -1), "lengths of its episodes don't add up to 1,000 rows"),
        (spoil("episodes/episode", 0, 7), "episodes/episode: inconsistent with"),
        (spoil("episodes/truncated", 0, 0), "ends of episodes"),
        (spoil("episodes/truncated", 0, 7), "ends of episodes"),
        (spoil("episodes/return", 0, 1), "episodes/return"),
    ],
)
def test_verify_finds_numbers_that_can_t_be(change, message, copied):
    forge(copied, change)
    problems = list(find_problems(copied))
    assert problems
    assert all("shard-00000.h5" in problem for problem in problems)
    assert any(re.search(message, problem) for problem in problems), problems


def test_verify_tells_all_that_is_wrong(copied):
    (copied / "shard-00001.h5").unlink()
    (copied / "shard-00002.h5").write_bytes(b"short")
    flip(np.random.default_rng(0), [copied / "shard-00004.h5"])
    shutil.copy(copied / "shard-00000.h5", copied / "copy.h5")
    problems = list(find_problems(copied))
    assert len(problems) == 4
    for name in ("00001.h5 is missing", "00002.h5 is damaged", "00004.h5 is damaged", "copy.h5"):
        assert sum(name in problem for problem in problems) == 1


def test_a_whole_data_set_has_no_problems(collected, tmp_path):
    assert not list(find_problems(collected))
    write_again(collected, tmp_path / "again")
    assert not list(find_problems(tmp_path / "again"))
    with pytest.raises(InputError, match="no data set in"):
        list(find_problems(tmp_path))
