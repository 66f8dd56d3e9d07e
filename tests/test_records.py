"""Records and their container: whatever changes in a file is noticed."""

import json
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import pytest
from command import refused
from msgspec import Meta
from small import flip_bit

from jbrep.errors import DamageError, InputError
from jbrep.records import container
from jbrep.records.document import Document, read_document
from jbrep.records.record import Finite, Record, from_plain, from_text
from jbrep.records.storage import publish, unfinished, write_new, write_whole


class Point(Record, frozen=True, array_like=True):
    name: Annotated[str, Meta(pattern=r"\A[a-z]+\Z")]
    height: Finite | None = None


class Source(Record, frozen=True, kw_only=True):
    sets: Annotated[int, Meta(ge=1, le=64)] = 1


class Plan(Document, frozen=True, kw_only=True):
    format: ClassVar[str] = "jbrep plan"
    format_version: ClassVar[int] = 3

    steps: Annotated[int, Meta(ge=1, le=10_000, description="Of training.")]
    rate: Annotated[float, Meta(gt=0, le=1, description="Of learning.")] = 0.5
    points: tuple[Point, ...] = ()
    source: Source | None = None
    kind: Annotated[Literal["first", "second"], Meta(description="Which one.")] = "first"
    more: Mapping[str, Any] = {}
    begin: str | None = msgspec.field(name="from", default=None)

    def check(self):
        if self.steps == 13:
            raise InputError("thirteen is one too many")


PLAN = Plan(steps=3, points=[Point("a", 1)], source=Source(sets=2), begin="b", more={"x": [1]})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "steps is 0: it must be int >= 1"),
        ({"steps": "\x1b[2J\n"}, r"steps is '\\x1b[2J\\n': it must be int"),
        ({"rate": float("nan")}, "rate is nan: it must be float > 0.0"),
        ({"kind": "third"}, "kind is 'third': it must be one of first, second"),
        ({"points": [["a", "b"]]}, "points[0][1] is 'b': it must be float"),
        ({"source": {"set": 1}}, "source.set: it must be one of sets"),
        ({"speed": 1}, "speed: it must be one of steps, rate, points"),
        ({"steps": ...}, "plan.steps is missing"),
        ({"steps": 13}, "thirteen is one too many"),
    ],
)
def test_a_mistake_is_one_line_with_field_value_and_what_is_allowed(changes, message):
    given = {name: each for name, each in {"steps": 3, **changes}.items() if each is not ...}
    assert message in refused(from_plain, given, Plan, "plan")


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("7", int | None, 7),
        ("5, 1,10", tuple[int, ...], (5, 1, 10)),
        ("size=2,mass=0.5", dict[str, float], {"size": 2, "mass": 0.5}),
        ("64,32", str, "64,32"),
    ],
)
def test_text_is_read_as_people_write_it(text, kind, value):
    assert from_text(text, kind, "it") == value
    if kind is not str:
        assert "it" in refused(from_text, "x", kind, "it")


def test_a_document_comes_back_equal_and_byte_for_byte(tmp_path):
    PLAN.write(tmp_path / "plan.json")
    back = read_document(tmp_path / "plan.json", Plan)
    assert back == PLAN
    assert back.text() == (tmp_path / "plan.json").read_text()
    plain = json.loads(PLAN.text())
    assert list(plain)[:2] == ["format", "format_version"]
    assert (plain["from"], plain["points"]) == ("b", [["a", 1.0]])


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        *[(text, DamageError) for text in ("", "[]", PLAN.text()[:-9], '{"format": "jbrep run"}')],
        *[(PLAN.text().replace('steps": 3', f'steps": {n}'), DamageError) for n in ("0", "1e999")],
        (PLAN.text().replace('version": 3', 'version": 2'), InputError),
        ('{"more": ' + 100_000 * "[" + 100_000 * "]" + "}", DamageError),
    ],
    ids=range(8),
)
def test_a_damaged_document_is_named(text, kind, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(kind) as refusal:
        read_document(path, Plan)
    assert type(refusal.value) is kind
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_file_is_written_whole_or_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "it"
    write_whole(path, b"before")
    assert f"{path} exists already" in refused(write_new, path, b"x")
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", lambda descriptor: (_ for _ in ()).throw(OSError("disk full")))
        assert f"can't write {path}: disk full" in refused(write_whole, path, b"after")
        assert "disk full" in refused(write_new, tmp_path / "new", b"after")
    assert path.read_bytes() == b"before"
    with unfinished(tmp_path / "folder") as partial:
        (partial / "in").mkdir(parents=True)
        write_new(partial / "in" / "it", b"x")
        publish(partial, tmp_path / "folder")
    assert sorted(each.name for each in tmp_path.rglob("*")) == ["folder", "in", "it", "it"]


def test_what_is_written_is_read_back_and_each_changed_bit_of_it_noticed(tmp_path):
    tensors = {
        "transposed": np.arange(6, dtype=np.float32).reshape(2, 3).T,
        "scalar": np.zeros(()),
        "empty": np.zeros((0, 3), np.int64),
        "flags": np.array([True, False]),
    }
    header = {"pair": (1, 2), "nested": {"b": None, "a": 1e-300}}
    container.write(tmp_path / "it", tensors, header)
    given, plain = container.read(tmp_path / "it", "thing")
    assert plain == {"pair": [1, 2], "nested": {"b": None, "a": 1e-300}}
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(given[name], tensor)
        assert given[name].dtype == tensor.dtype
    container.write(tmp_path / "again", given, plain)
    whole = (tmp_path / "it").read_bytes()
    assert (tmp_path / "again").read_bytes() == whole
    for bit in range(8 * len(whole) - 200, 8 * len(whole)):
        flip_bit(tmp_path / "it", bit)
        with pytest.raises(DamageError, match="is damaged"):
            container.read(tmp_path / "it", "thing")
        flip_bit(tmp_path / "it", bit)
