"""The options of a command and the keys in docs, from the fields of a record."""

from typing import Annotated, Literal

import click
import pytest
from click.testing import CliRunner
from msgspec import Meta, field

from jbrep.cli.options import record_options
from jbrep.errors import InputError
from jbrep.records.record import Record


class Walk(Record, frozen=True, kw_only=True):
    steps: Annotated[int, Meta(ge=1, le=10_000, description="In all.")]
    length: Annotated[float, Meta(gt=0, description="Of each [m].")] = 0.5
    gait: Annotated[Literal["trot", "pace"], Meta(extra={"default": "what is usual"})] = "trot"
    start_at: Annotated[str, Meta(description="Where.")] = field(name="from", default="")
    seed: int | None = None
    back: Annotated[bool, Meta(description="And home again.")] = False


@click.command()
@record_options(Walk, length=0.25)
def walk(**given):
    click.echo(Walk(**given))


def test_options_are_a_records_fields():
    line = "--steps 5k --gait pace --from here --back"
    ran = CliRunner().invoke(walk, line.split())
    assert ran.output.strip() == repr(
        Walk(steps=5000, length=0.25, gait="pace", start_at="here", back=True)
    )
    usual = CliRunner().invoke(walk, ["--steps", "1"])
    assert usual.output.strip() == repr(Walk(steps=1, length=0.25))


def test_the_help_of_an_option_is_its_fields():
    text = " ".join(CliRunner().invoke(walk, ["--help"]).output.split())
    assert "--steps NUMBER In all. [required]" in text
    assert "--length FLOAT Of each [m]. [default: 0.25]" in text
    assert "--gait [pace|trot] [default: what is usual]" in text
    assert "--back And home again. --help" in text


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("--steps 0", "steps is 0: it must be `int` >= 1"),
        ("--steps 1 --gait fly", "gait is 'fly': it must be one of pace, trot"),
    ],
)
def test_the_record_says_what_a_value_must_be(given, told):
    error = CliRunner().invoke(walk, given.split()).exception
    assert isinstance(error, InputError)
    assert str(error) == told
