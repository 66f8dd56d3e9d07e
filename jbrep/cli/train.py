"""Making encoders, with options from the settings of the methods."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import inspect

from jbrep.cli.base import PATH, POSITIVE, RESUMES, Variadic, data_option, with_options
from jbrep.cli.completion import complete_kind
from jbrep.cli.environment import import_option
from jbrep.cli.output import tell
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError, choose
from jbrep.methods.kinds import KINDS
from jbrep.records.keys import Key, keys_of, option_name
from jbrep.records.record import bare

if TYPE_CHECKING:
    from jbrep.training.method import Method

_FEW = 3  # kinds: where only so many don't take a setting, help names those


class _Making(Variadic):
    """A command with an option for each setting of the methods that it offers."""

    kinds: tuple[str, ...] = ()  # all of them if empty

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Check the kind before its settings are asked for, which imports torch."""
        for option, value in pairwise(args):
            if option == "--kind":
                choose(value, KINDS, "kind")
        return super().parse_args(ctx, args)

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The command's own options, those of its methods, and --help."""
        *own, last = super().get_params(ctx)
        return [*own, *self._settings, last]

    @cached_property
    def _methods(self) -> "dict[str, type[Method]]":
        from jbrep.methods.registry import METHODS  # imports torch

        return {kind: METHODS[kind] for kind in self.kinds or METHODS}

    @cached_property
    def _settings(self) -> list[click.Option]:
        """An option for each setting, those of most kinds first."""
        taking: dict[str, dict[str, Key]] = {}  # by setting and kind
        for kind, method in self._methods.items():
            for key in keys_of(method):
                taking.setdefault(key.name, {})[kind] = key
        by_use = sorted(taking.items(), key=lambda setting: -len(setting[1]))
        return [self._made(name, keys) for name, keys in by_use]

    def _made(self, name: str, taking: Mapping[str, Key]) -> click.Option:
        key = next(iter(taking.values()))
        kind, words = bare(key.kind), f"{key.help}{self._use(taking)}"
        if isinstance(kind, inspect.BoolType):
            return click.Option([option_name(name)], is_flag=True, default=None, help=words)
        several = name == "latent" or isinstance(kind, inspect.CollectionType | inspect.DictType)
        metavar = "VALUE..." if several else "VALUE"
        return click.Option([option_name(name)], multiple=several, metavar=metavar, help=words)

    def _use(self, taking: Mapping[str, Key]) -> str:
        """Which kinds take a setting, and its default: [slow: 10; forward: 1,5,10,20]."""
        kinds: dict[str, list[str]] = {}  # by default
        for kind, key in taking.items():
            kinds.setdefault(_shown(key), []).append(kind)
        others = [kind for kind in self._methods if kind not in taking]
        if list(kinds) == [""] and not others:
            return ""  # all take it, and none has a default
        said = {", ".join(each): default for default, each in kinds.items()}
        if len(kinds) == 1 and len(others) <= _FEW:
            said = {f"all but {', '.join(others)}" if others else "default": next(iter(kinds))}
        elif not others and len(most := max(kinds.values(), key=len)) > _FEW:
            said = {"others" if each == most else ", ".join(each): d for d, each in kinds.items()}
        parts = [f"{who}: {default}" if default else who for who, default in said.items()]
        return f"  [{'; '.join(parts)}]"

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the command's options, the kinds, and the settings."""
        own = [each for each in self.get_params(ctx) if each not in self._settings]
        sections = {
            "Options": _help_of(own, ctx),
            "Kinds": [(kind, method.words()) for kind, method in self._methods.items()],
            "Settings": _help_of(self._settings, ctx),
        }
        if len(self._methods) == 1:
            del sections["Kinds"]
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def _help_of(options: Sequence[click.Parameter], ctx: click.Context) -> list[tuple[str, str]]:
    return [record for each in options if (record := each.get_help_record(ctx))]


def _shown(key: Key) -> str:
    """A default as help shows it; empty if there is none, or nothing to say."""
    if isinstance(key.default, tuple):
        return ",".join(map(str, key.default))
    return "" if key.default is False else key.default_shown


def _given(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a method that options give, as text; sizes of the latent as a list."""
    from jbrep.methods.registry import METHODS, get_method

    method = get_method(kind)
    given = {
        name: ",".join(value) if isinstance(value, tuple) else value
        for name, value in options.items()
        if value not in (None, ())
    }
    for name in given:
        if not method.takes(name):
            kinds = ", ".join(each for each, m in METHODS.items() if m.takes(name))
            raise InputError(
                f"{kind} takes no {option_name(name)}: leave it out; it is for {kinds}"
            )
    if not method.takes("latent"):
        return given
    if "latent" not in given:
        raise InputError(f"{kind} needs --latent, such as --latent 12 8 4")
    return {**given, "latent": given["latent"].rstrip(",").split(",")}


class _Dae(_Making):
    """For the denoising autoencoder alone."""

    kinds = ("dae",)


_making = with_options(
    data_option,
    click.option("--out", required=True, type=PATH, help="A folder for the encoder files."),
    click.option("--name", help="What files and tables call it; by default, what it is."),
    click.option("--device", default="auto", show_default=True, help="cpu, cuda, or auto."),
    click.option(
        "--seeds",
        type=POSITIVE,
        metavar="N",
        help="Make N of each, of the seeds 0 to N - 1: NAME-s0, NAME-s1, ...",
    ),
    click.option("--preset", help="Named settings; of dae: authors, its authors' own."),
    import_option,
)


@click.command(
    cls=_Dae,
    epilog="Example: jbrep train-dae --data data/face --latent 12 8 4 --out encoders/face",
)
@_making
def train_dae(**options: Any) -> None:
    """Train denoising autoencoders.

    They learn from 80 % of the episodes, with the paper's settings by default, and are compared
    with PCA on the others. Ctrl-C keeps the best so far, and the same command resumes.
    """
    _fit("dae", **options)


@click.command(
    cls=_Making,
    epilog="Example: jbrep train-encoder --kind slow --data data/face --latent 8 "
    "--out encoders/face",
)
@click.option("--kind", required=True, shell_complete=complete_kind, help="One of those below.")
@_making
def train_encoder(kind: str, **options: Any) -> None:
    """Make encoders of any kind.

    They learn from 80 % of the episodes, and say how good they are at what their kind is for. Each
    kind takes only some of the settings.
    """
    _fit(kind, **options)


def _fit(
    kind: str,
    data: Path,
    out: Path,
    name: str | None,
    seeds: int | None,
    device: str,
    preset: str | None,
    **options: Any,
) -> None:
    from jbrep import api

    given = _given(kind, options)
    made = api.train_encoders(
        data, out, kind, seeds=seeds, name=name, preset=preset, device=device, **given
    )
    with stoppable(f"{RESUMES}; the best so far is in {out}"):
        for each in made:
            tell(str(each))
