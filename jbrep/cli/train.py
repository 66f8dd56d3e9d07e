"""Making encoders, with options from the settings of the methods."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

import click
from msgspec import inspect

from jbrep import api
from jbrep.cli.base import RESUMES, command, tell
from jbrep.cli.generator import Command
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError, choose
from jbrep.methods.kinds import KINDS
from jbrep.records.keys import Key, keys_of, option_name
from jbrep.records.record import bare

if TYPE_CHECKING:
    from jbrep.training.method import Method

_FEW = 3  # kinds: where only so many don't take a setting, help names those


class _Making(Command):
    """A command with an option for each setting of the methods that it offers."""

    kinds: tuple[str, ...] = ()  # all of them if empty

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Check the kind before its settings are asked for, which imports torch."""
        for option, value in pairwise(args):
            if option == "--kind":
                choose(value, KINDS, "kind")
                ctx.meta["kind"] = value  # help shows its settings alone
        return super().parse_args(ctx, args)

    def options(self) -> list[click.Parameter]:
        left_out = {"latent", "kind"} if len(self.kinds) == 1 else {"latent"}
        own = [each for each in super().options() if each.name not in left_out]
        return [*own, *self._settings]

    @cached_property
    def _methods(self) -> "dict[str, type[Method]]":
        from jbrep.methods.registry import METHODS  # imports torch

        return {kind: METHODS[kind] for kind in self.kinds or METHODS}

    @cached_property
    def _settings(self) -> list[click.Option]:
        """An option for each setting, those of most kinds first."""
        return self._settings_of(self._methods)

    def _settings_of(self, methods: "Mapping[str, type[Method]]") -> list[click.Option]:
        taking: dict[str, dict[str, Key]] = {}  # by setting and kind
        for kind, method in methods.items():
            for key in keys_of(method):
                taking.setdefault(key.name, {})[kind] = key
        by_use = sorted(taking.items(), key=lambda setting: -len(setting[1]))
        return [_made(name, keys, methods) for name, keys in by_use]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the command's options, the kinds, and the settings."""

        def records(options: Iterable[click.Parameter]) -> list[tuple[str, str]]:
            return [record for each in options if (record := each.get_help_record(ctx))]

        methods, settings = self._methods, self._settings
        if (kind := ctx.meta.get("kind")) in methods:
            methods = {kind: methods[kind]}
            settings = self._settings_of(methods)
        sections = {
            "Options": records(p for p in self.get_params(ctx) if p not in self._settings),
            "Kinds": [(kind, method.words()) for kind, method in methods.items()],
            "Settings": records(settings),
        }
        if len(self.kinds) == 1:
            del sections["Kinds"]
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl(rows)


def _made(name: str, taking: Mapping[str, Key], kinds: Iterable[str]) -> click.Option:
    key = next(iter(taking.values()))
    kind, words = bare(key.kind), f"{key.help}{_use(taking, kinds)}"
    if isinstance(kind, inspect.BoolType):
        return click.Option([option_name(name)], is_flag=True, default=None, help=words)
    several = name == "latent" or isinstance(kind, inspect.CollectionType | inspect.DictType)
    metavar = "VALUE..." if several else "VALUE"
    return click.Option([option_name(name)], multiple=several, metavar=metavar, help=words)


def _use(taking: Mapping[str, Key], every: Iterable[str]) -> str:
    """Which kinds take a setting, and its default: [slow: 10; forward: 1,5,10,20]."""
    kinds: dict[str, list[str]] = {}  # by default
    for kind, key in taking.items():
        kinds.setdefault(_shown(key), []).append(kind)
    others = [kind for kind in every if kind not in taking]
    if list(kinds) == [""] and not others:
        return ""  # all take it, and none has a default
    said = {", ".join(each): default for default, each in kinds.items()}
    if len(kinds) == 1 and len(others) <= _FEW:
        said = {f"all but {', '.join(others)}" if others else "default": next(iter(kinds))}
    elif not others and len(most := max(kinds.values(), key=len)) > _FEW:
        said = {"others" if each == most else ", ".join(each): d for d, each in kinds.items()}
    parts = [f"{who}: {default}" if default else who for who, default in said.items()]
    return f"  [{'; '.join(parts)}]"


def _shown(key: Key) -> str:
    """A default as help shows it; empty if there is none, or nothing to say."""
    if isinstance(key.default, tuple):
        return ",".join(map(str, key.default))
    return "" if key.default is False else key.default_shown


def _read(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options with settings of a method as it reads them: text; sizes of the latent as a list."""
    from jbrep.methods.registry import METHODS, get_method

    method = get_method(kind)
    settings = {key.name for each in METHODS.values() for key in keys_of(each)}
    given = {name: ",".join(v) if isinstance(v, tuple) else v for name, v in options.items()}
    for name in settings & {*given}:
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


@command("train-dae --data data/face --latent 12 8 4 --out encoders/face", _Dae)
def train_dae(**options: Annotated[Any, api.train_encoders]) -> None:
    """Train denoising autoencoders.

    They learn from 80 % of the episodes, with the paper's settings by default, and are compared
    with PCA on the others. Ctrl-C keeps the best so far, and the same command resumes.
    """
    train_encoder("dae", **options)


@command("train-encoder --kind slow --data data/face --latent 8 --out encoders/face", _Making)
def train_encoder(kind: str, **options: Annotated[Any, api.train_encoders]) -> None:
    """Make encoders of any kind.

    They learn from 80 % of the episodes, and report how well they do what their kind is for. Each
    kind takes only some of the settings.

    Args:
        kind: a kind listed below.
    """
    given = _read(kind, options)
    with stoppable(f"{RESUMES}; the best so far is in {given['out']}"):
        for each in api.train_encoders(kind=kind, **given):
            tell(str(each))
