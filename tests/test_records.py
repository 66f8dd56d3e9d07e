"""Records: each value is checked once, wherever it comes from, and each mistake is one line."""

import json
import random
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import pytest
from key_table import key_table
from msgspec import Meta

from jbrep.errors import DamageError, InputError
from jbrep.records.document import Document, read_document, sealed
from jbrep.records.record import Finite, Record, from_plain, from_text, to_plain
from jbrep.records.toml import toml_text

Count = Annotated[int, Meta(ge=1, le=10_000)]


class Point(Record, frozen=True, array_like=True):
    name: Annotated[str, Meta(pattern=r"\A[a-z]+\Z", title="a word")]
    height: Finite | None = None


class Source(Record, frozen=True, kw_only=True):
    sets: Annotated[int, Meta(ge=1, le=64)] = 1


class Plan(Document, frozen=True, kw_only=True):
    format: ClassVar[str] = "jbrep plan"
    format_version: ClassVar[int] = 3

    steps: Annotated[Count, Meta(description="Of training.")]
    rate: Annotated[float, Meta(gt=0, le=1, description="Of learning.")] = 0.5
    points: tuple[Point, ...] = ()
    source: Source | None = None
    kind: Annotated[Literal["first", "second"], Meta(description="Which one.")] = "first"
    more: Mapping[str, Any] = {}
    begin: str | None = msgspec.field(name="from", default=None)
    pair: Annotated[tuple[Finite, ...], Meta(min_length=1, max_length=2)] = (0.0,)
    chosen: Annotated[tuple[Literal["a", "b"], ...], Meta(min_length=1)] = ("a",)
    flags: tuple[bool, ...] = ()
    names: tuple[Annotated[str, Meta(min_length=1, title="a name")], ...] = ()

    def check(self):
        if self.steps == 13:
            raise InputError("thirteen is one too many")


PLAN = Plan(steps=3, points=[Point("a", 1)], source=Source(sets=2), begin="b", more={"x": [1]})
LISTS = ("pair", "chosen", "flags", "names")
MISTAKES = [
    ({"steps": 0}, "steps is 0: it must be a whole number from 1 to 10,000"),
    ({"steps": True}, "steps is True: it must be a whole number from 1 to 10,000"),
    ({"steps": 1.0}, "steps is 1.0: it must be a whole number from 1 to 10,000"),
    ({"steps": 10**400}, "steps is 1000000000.*: it must be a whole number"),
    ({"steps": "\x1b[2J\n"}, r"steps is '\\\\x1b\[2J\\\\n': it must be a whole number"),
    ({"rate": 0}, "rate is 0: it must be a number above 0 and at most 1"),
    ({"rate": float("nan")}, "rate is nan: it must be a number above 0"),
    ({"kind": "third"}, "kind is 'third': it must be one of first, second"),
    ({"points": [["a", "b"]]}, r"points\[0\]\.height is 'b': it must be a finite number"),
    ({"points": [["A"]]}, r"points\[0\]\.name is 'A': it must be a word"),
    ({"points": [["a", 1, 2]]}, r"points\[0\] is .*: it must be a list of name, height"),
    ({"points": 3}, "points is 3: it must be a list"),
    ({"source": {"sets": 65}}, "source.sets is 65: it must be a whole number from 1 to 64"),
    ({"source": {"set": 1}}, "unknown source.set: it must be one of sets"),
    ({"source": 3}, "source is 3: it must be a table"),
    ({"more": [1]}, r"more is \[1\]: it must be a table"),
    ({"speed": 1}, "unknown speed: it must be one of steps, rate"),
    ({"steps": 13}, "thirteen is one too many"),
    ({"pair": []}, r"pair is \[\]: it must be a list of 1 to 2 finite numbers$"),
    ({"chosen": []}, r"chosen is \[\]: it must be a list of at least 1, each one of a, b$"),
    ({"flags": 3}, "flags is 3: it must be a list, each true or false$"),
    ({"names": 3}, "names is 3: it must be a list of names$"),
]


@pytest.mark.parametrize(("changes", "message"), MISTAKES)
def test_a_mistake_is_one_line_that_says_what_must_be(changes, message):
    with pytest.raises(InputError, match=message) as refusal:
        from_plain({"steps": 3, **changes}, Plan)
    assert len(str(refusal.value)) < 200
    assert str(refusal.value).isprintable()
    if changes.keys() <= {"steps", "rate", "kind", "points"}:
        with pytest.raises(InputError, match=message):  # in Python as from a file
            PLAN.replace(**changes)


def test_what_is_missing_is_named_with_its_place():
    with pytest.raises(InputError, match=r"^steps is missing$"):
        from_plain({}, Plan)
    with pytest.raises(InputError, match=r"^plan\.steps is missing$"):
        from_plain({}, Plan, "plan")


def test_values_become_those_of_their_fields_types():
    made = Plan(steps=np.int64(5), rate=1, points=[Point("a")])
    assert (type(made.steps), type(made.rate), made.points) == (int, float, (Point("a"),))
    assert made.replace(steps=6).steps == 6
    with pytest.raises(AttributeError):
        made.steps = 7


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("0.5", float, 0.5),
        ("7", int | None, 7),
        ("5, 1,10", tuple[int, ...], (5, 1, 10)),
        ("a,b", tuple[str, ...], ("a", "b")),
        ("size=2,mass=0.5", dict[str, float], {"size": 2, "mass": 0.5}),
        ("64,32", str, "64,32"),
    ],
)
def test_text_is_read_as_people_write_it(text, kind, value):
    assert from_text(text, kind, "it") == value


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("x", Annotated[int, Meta(ge=1)], "it is 'x': it must be a whole number from 1"),
        ("1,x", tuple[int, ...], r"it\[1\] is 'x': it must be a whole number"),
        ("size", dict[str, float], "it is 'size': it must be a table"),
    ],
)
def test_text_that_is_no_such_value_is_refused(text, kind, message):
    with pytest.raises(InputError, match=message):
        from_text(text, kind, "it")


def test_a_document_comes_back_equal_and_byte_for_byte(tmp_path):
    PLAN.write(tmp_path / "plan.json")
    back = read_document(tmp_path / "plan.json", Plan)
    assert back == PLAN
    assert back.text() == (tmp_path / "plan.json").read_text() == PLAN.text()
    plain = json.loads(PLAN.text())
    assert list(plain)[:3] == ["format", "format_version", "sha256"]
    assert (plain["from"], plain["points"]) == ("b", [["a", 1.0]])


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("", DamageError, "damaged, or not a jbrep plan"),
        ("[]", DamageError, "must be an object"),
        ('{"format": "jbrep run"}', DamageError, "damaged, or not a jbrep plan"),
        ('{"format": "jbrep plan"}', DamageError, "its format version is None"),
        ('{"format": "jbrep plan", "format_version": true}', DamageError, "version is True"),
        ('{"format": "jbrep plan", "format_version": 2}', InputError, "reads version 3 alone"),
        ('{"format": "jbrep plan", "format_version": 4}', InputError, "reads version 3 alone"),
        ('{"format": "jbrep plan", "format_version": 3, "steps": 0}', DamageError, "steps is 0"),
        ('{"format": "jbrep plan", "rate": NaN}', DamageError, "damaged"),
        ('{"format": "jbrep plan", "rate": 1e999}', DamageError, "damaged"),
        ('{"more": ' + 100_000 * "[" + 100_000 * "]" + "}", DamageError, "damaged"),
        ('{"from": "\\ud800"}', DamageError, "damaged"),
    ],
)
def test_a_damaged_document_is_named(text, kind, message, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(text)
    with pytest.raises(kind, match=message) as refusal:
        read_document(path, Plan)
    assert type(refusal.value) is kind
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_links_pipes_and_large_files_are_not_read(tmp_path, monkeypatch):
    PLAN.write(tmp_path / "plan.json")
    (tmp_path / "link.json").symlink_to(tmp_path / "plan.json")
    with pytest.raises(DamageError):
        read_document(tmp_path / "link.json", Plan)
    monkeypatch.setattr(Plan, "max_bytes", 10)
    with pytest.raises(DamageError):
        read_document(tmp_path / "plan.json", Plan)
    with pytest.raises(InputError, match=r"can't read .*none"):
        read_document(tmp_path / "none.json", Plan)


def test_whatever_is_written_over_a_document_is_refused_or_read_whole(tmp_path):
    """Some 3,000 spoiled texts: nothing but the two errors, and nothing that doesn't fit."""
    path, rng, text = tmp_path / "plan.json", random.Random(0), PLAN.text().encode()
    for _ in range(3000):
        spoiled = bytearray(text)
        for _ in range(rng.randint(1, 3)):
            place = rng.randrange(len(spoiled))
            match rng.randrange(3):
                case 0:
                    spoiled[place] = rng.randrange(256)
                case 1:
                    del spoiled[place : place + rng.randint(1, 20)]
                case _:
                    spoiled[place:place] = rng.choice((b"null", b"-1", b"[", b"1e400", b'"', b"{"))
        path.write_bytes(spoiled)
        with suppress(InputError):
            read = read_document(path, Plan)
            assert from_plain(to_plain(read), Plan) == read


def test_toml_comes_back():
    tables = {"a": {"steps": 3, "of": (1, 2), "text": 'say "no"\n', "none": None}, "dotted.key": 1}
    assert tomllib.loads(toml_text(tables)) == {
        "a": {"steps": 3, "of": [1, 2], "text": 'say "no"\n', "none": "none"},
        "dotted.key": 1,
    }


def test_the_table_of_keys_says_what_each_may_be():
    lines = key_table(
        Plan, of="plan", without=("points", "source", "more", "from", *LISTS)
    ).splitlines()
    assert lines[2:] == [
        "| `plan.steps` | a whole number from 1 to 10,000 |  | Of training. |",
        "| `plan.rate` | a number above 0 and at most 1 | 0.5 | Of learning. |",
        "| `plan.kind` | one of first, second | first | Which one. |",
    ]


def test_a_document_that_was_changed_is_refused(tmp_path):
    """Whichever digit it is, unless the checksum is worked out anew."""
    path, text = tmp_path / "plan.json", PLAN.text()
    for place, letter in enumerate(text):
        if letter.isdecimal():
            path.write_text(f"{text[:place]}{(int(letter) + 1) % 10}{text[place + 1 :]}")
            with pytest.raises(InputError):
                read_document(path, Plan)
    path.write_text(text.replace('"b"', '"c"'))
    with pytest.raises(DamageError, match="was changed after it was written, or is damaged"):
        read_document(path, Plan)
    path.write_text(json.dumps(sealed(json.loads(path.read_text()))))
    assert read_document(path, Plan) != PLAN
