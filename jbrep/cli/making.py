"""Options from the settings of the methods, and help that says which kind takes which."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import Variadic
from jbrep.errors import InputError, choose

if TYPE_CHECKING:
    from jbrep.methods.method import Method
    from jbrep.methods.settings import Setting


_FEW = 3  # kinds that a setting of most kinds may not be of


def option_of(setting: str) -> str:
    """The option that gives a setting: --batch-size."""
    return f"--{setting.replace('_', '-')}"


class Making(Variadic):
    """A command with an option for each setting of the methods that it offers."""

    kinds: tuple[str, ...] = ()  # all of them if empty

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The command's own options, those of its methods, and --help."""
        *own, last = super().get_params(ctx)
        return [*own, *self._shared, *self._others, last]

    @cached_property
    def _methods(self) -> "list[Method]":
        from jbrep.methods.registry import METHODS  # imports torch

        return [METHODS[name] for name in self.kinds or METHODS]

    @cached_property
    def _shared(self) -> list[click.Parameter]:
        """Options of most kinds."""
        return [each for each in self._settings if self._is_shared(each)]

    @cached_property
    def _others(self) -> list[click.Parameter]:
        return [each for each in self._settings if not self._is_shared(each)]

    def _is_shared(self, option: click.Parameter) -> bool:
        return len(self._taking(str(option.name))) >= len(self._methods) - _FEW

    def _taking(self, name: str) -> "list[Method]":
        return [method for method in self._methods if name in method.defaults]

    @cached_property
    def _settings(self) -> list[click.Parameter]:
        from jbrep.methods.settings import SETTINGS

        return [self._option(name, SETTINGS[name]) for name in SETTINGS if self._taking(name)]

    def _option(self, name: str, setting: "Setting") -> click.Option:
        how: dict[str, Any] = {"help": f"{setting.words}{self._use(name)}"}
        if setting.is_flag:
            how |= {"is_flag": True, "default": None}
        else:
            is_list = setting.is_list or name == "latent"
            how |= {"type": _Value(setting, name == "latent"), "multiple": is_list}
            how["metavar"] = "VALUE..." if is_list else "VALUE"
        return click.Option([option_of(name)], **how)

    def _use(self, name: str) -> str:
        """Which kinds take a setting, and its default: [slow: 10; forward: 1,5,10,20]."""
        taking = self._taking(name)
        kinds: dict[str, list[str]] = {}
        for method in taking:
            kinds.setdefault(_shown(method.fill({})[name]), []).append(_name(method))
        if len(taking) == len(self._methods):
            by = {"default" if len(kinds) == 1 else ", ".join(k): v for v, k in kinds.items()}
            parts = [f"{who}: {value}" for who, value in by.items() if value]
        elif len(kinds) == 1 and len(self._methods) - _FEW <= len(taking) > _FEW:
            left_out = [_name(method) for method in self._methods if method not in taking]
            parts = [_with_default(f"all but {', '.join(left_out)}", next(iter(kinds)))]
        else:
            parts = [_with_default(", ".join(each), value) for value, each in kinds.items()]
        return f"  [{'; '.join(parts)}]" if parts else ""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options by what they are of, and the kinds."""
        own = [each for each in self.get_params(ctx) if each not in self._settings]
        is_one = len(self._methods) == 1
        sections: dict[str, Sequence[click.Parameter]] = {
            "Options": own,
            "Settings" if is_one else "Settings of most kinds": self._shared,
            "Settings of some kinds": self._others,
        }
        for title, options in sections.items():
            records = [record for each in options if (record := each.get_help_record(ctx))]
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)
            if title == "Options" and not is_one:
                with formatter.section("Kinds"):
                    formatter.write_dl([(_name(each), each.words) for each in self._methods])


class _Value(click.ParamType[Any]):
    """A value of a setting; of latent, sizes: 8, or 12,8,4."""

    name = "value"

    def __init__(self, setting: "Setting", are_sizes: bool):
        self._setting, self._are_sizes = setting, are_sizes

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """As for click."""
        try:
            if self._are_sizes:
                return tuple(map(self._setting.read, value.removesuffix(",").split(",")))
            return self._setting.read(value)
        except InputError as error:
            self.fail(str(error))
        except ValueError as error:
            self.fail(f"{value!r} must be {error}")


def _name(method: "Method") -> str:
    from jbrep.encoders.encoder import FULL, IDENTITY

    return FULL if method.name == IDENTITY else method.name


def _with_default(kinds: str, value: str) -> str:
    return f"{kinds}: {value}" if value else kinds


def _shown(default: Any) -> str:
    """A default as help shows it; empty if there is none, or nothing to say."""
    from jbrep.methods.settings import REQUIRED

    if default is REQUIRED or default is None or default is False or default in ((), {}):
        return ""
    if isinstance(default, tuple):
        return ",".join(map(str, default))
    return f"{default:g}" if isinstance(default, float) else str(default)


def read_options(kind: str, options: Mapping[str, Any], preset: str | None) -> dict[str, Any]:
    """The settings of a method that options and a preset give; sizes are left as they are.

    Raises:
        InputError: the method doesn't take one, or needs another, or has no such preset.
    """
    from jbrep.methods.registry import METHODS, get_method
    from jbrep.methods.settings import REQUIRED

    method = get_method(kind)
    given = {name: _joined(value) for name, value in options.items() if value not in (None, ())}
    for name in given:
        if name not in method.defaults:
            kinds = ", ".join(_name(each) for each in METHODS.values() if name in each.defaults)
            raise InputError(f"{kind} takes no {option_of(name)}: leave it out; it is for {kinds}")
    for name, default in method.defaults.items():
        if default is REQUIRED and name not in given:
            sizes = ", such as --latent 12 8 4" if name == "latent" else ""
            raise InputError(f"{kind} needs {option_of(name)}{sizes}")
    if preset is None:
        return given
    if not method.presets:
        raise InputError(f"{kind} has no presets: leave out --preset")
    return {**choose(preset, method.presets, f"preset of {kind}"), **given}


def _joined(value: Any) -> Any:
    """The parts of an option that was given several values, as one."""
    if not isinstance(value, tuple):
        return value
    if isinstance(value[0], Mapping):
        return {name: each for part in value for name, each in part.items()}
    return tuple(dict.fromkeys(each for part in value for each in part))
