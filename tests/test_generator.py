"""Commands read off Python functions: options, and what is refused."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from click.testing import CliRunner
from msgspec import Meta, field

from jbrep.cli.generator import Command
from jbrep.errors import InputError
from jbrep.records.record import Record


class Walk(Record, frozen=True, kw_only=True):
    steps: Annotated[int, Meta(ge=1, le=10_000)]
    length: Annotated[float, Meta(gt=0)] = 0.5
    gait: Literal["trot", "pace"] = "trot"
    start_at: str = field(name="from", default="")
    legs: tuple[int, ...] = ()


def robot(name: str = "bug", mass: Annotated[float, Meta(gt=0)] = 1.0) -> str:
    return f"{name} of {mass} kg"


def walk(
    out: Path,
    name: Annotated[str, Meta(extra={"made_by": robot})],
    *,
    back: Annotated[bool, Meta(description="And home again.")] = False,
    lower: Mapping[str, Any] = {},
    hide: Sequence[str] = (),
    **walk: Annotated[Any, Walk],
) -> int:
    """Walk."""
    print({"out": out, "name": name, "back": back, "lower": lower, "hide": hide, **walk})
    return 3


def follow(leader: str, /, back: bool, **options: Annotated[Any, walk]) -> None:
    print(leader, back, options)


def run(line, function=walk):
    command = Command(function.__name__, function, "walk --out x")
    return CliRunner().invoke(command, line.split(), standalone_mode=False, catch_exceptions=True)


def test_parameters_of_functions_and_fields_of_records_are_options():
    ran = run("--out x --steps 5k --mass 2 --gait pace --from here --legs 1,2 --lower a=1 b=c")
    assert eval(ran.output, {"PosixPath": Path}) == {
        **{"out": Path("x"), "name": "bug of 2.0 kg", "back": False, "lower": {"a": 1, "b": "c"}},
        **{"hide": (), "steps": 5000, "gait": "pace", "start_at": "here", "legs": (1, 2)},
    }
    assert ran.exception.code == 3


def test_a_function_may_take_the_options_of_another():
    ran = run("bug --out x --steps 5 --hide a b --back", follow)
    assert ran.exception is not None  # with an argument, an option takes one value
    ran = run("bug --out x --steps 5 --hide a --hide b --back", follow)
    assert ran.output.startswith(
        "bug True {'out': PosixPath('x'), 'name': 'bug of 1.0 kg', 'hide': ('a', 'b'), "
    )


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("--steps 0", "steps is 0"),
        ("--steps 1 --gait fly", "gait is 'fly': it must be one of pace, trot"),
        ("--steps 1 --mass 0", "mass is '0'"),
        ("--steps 1 --lower a", "lower a isn't an argument"),
    ],
)
def test_the_annotation_says_what_a_value_must_be(given, told):
    error = run(f"--out x {given}").exception
    assert isinstance(error, InputError)
    assert re.search(re.escape(told), str(error))
