"""Commands, read off Python functions: options from parameters, help from docstrings.

A parameter is an option of the same name; one that is positional only, an argument. Its type and
range are its annotation's; what it means, the docstring's `Args` say, or the annotation's
`Meta(description=...)`. Its default is the function's own. `Meta(extra={...})` may give another
name as `option`, a `metavar`, the `default` in words, or the function that makes the value of
options of its own, `made_by`. `**others: Annotated[Any, source]` has the options of other functions
or the fields of a record, too.
"""

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import click
from msgspec import NODEFAULT, Meta

from jbrep.errors import InputError
from jbrep.records.keys import Key, keys_of, option_name
from jbrep.records.record import converted, from_text, with_zeros

_Parameter = inspect.Parameter
_SECTIONS = re.compile(r"\n+(Args|Returns|Raises):\n.*", re.DOTALL)
_ARGUMENT = re.compile(r"^    \*{0,2}(\w+): (.*(?:\n {8}.*)*)", re.MULTILINE)
_METAVARS = {bool: None, int: "NUMBER", float: "FLOAT", Path: "PATH", Mapping: "NAME=VALUE"}


class Option(NamedTuple):
    """An option or argument of a command, for a parameter of a function or a record's field."""

    key: Key
    is_argument: bool = False
    is_of_record: bool = False
    takes_all: bool = False  # an argument that takes any number of values

    @property
    def kind(self) -> Any:
        """The type of a value, or Sequence or Mapping."""
        for part in _parts(self.key.annotation):
            origin = get_origin(part) or part
            if origin is Literal or origin in (bool, int, float, Path):
                return origin
            if isinstance(origin, type) and issubclass(origin, Mapping):
                return Mapping
            if isinstance(origin, type) and issubclass(origin, Sequence) and origin is not str:
                return Sequence
        return str

    @property
    def name(self) -> str:
        """As it is typed."""
        return option_name(self.key.extra.get("option", self.key.name))

    def read(self, context: click.Context, parameter: click.Parameter, given: Any) -> Any:
        """The value of what is typed; None where nothing is."""
        if given in (None, ()) or isinstance(given, bool):
            return given or None
        if self.key.extra.get("is_code"):
            _import_code(given if isinstance(given, tuple) else (given,))
        if isinstance(given, tuple):
            if not self.is_of_record:
                return parse_pairs(given, self.name) if self.kind is Mapping else given
            given = ",".join(given)
        if self.kind is Path:
            return Path(given)
        kind = self.key.annotation if self.is_of_record or self.kind is not str else str
        return from_text(given, kind, self.name.lstrip("-") if self.is_of_record else self.name)

    def parameter(self, options: Mapping[str, str]) -> click.Parameter:
        """It as click's; `options` are the names of those that its help may speak of."""
        key, kind = self.key, self.kind
        is_required = key.default is NODEFAULT
        complete = _COMPLETE.get(key.extra.get("option", key.field))
        if self.is_argument:
            return click.Argument(
                [key.field],
                required=is_required,
                nargs=-1 if self.takes_all else 1,
                callback=self.read,
                shell_complete=complete,
            )
        shown = key.default_shown
        default = f"  [default: {shown}]" if shown and shown != "false" else ""
        metavar = _METAVARS.get(kind, "TEXT")
        if kind is Literal:
            choices = (str(each) for part in _parts(key.annotation) for each in get_args(part))
            metavar = f"[{'|'.join(sorted(filter(None, choices)))}]"
        usual = {"is_flag": kind is bool or None, "multiple": kind in (Mapping, Sequence)}
        return click.Option(
            [self.name, key.field],
            required=is_required,
            metavar=key.extra.get("metavar", metavar),
            help=_with_options(key.help[:1].upper() + key.help[1:], options) + default,
            callback=self.read,
            shell_complete=complete,
            **usual | key.extra.get("click", {}),
        )


def _is_union(annotation: Any) -> bool:
    return get_origin(annotation) in (Union, UnionType)


def _parts(annotation: Any) -> Iterator[Any]:
    """The types of a union, without what is said of them."""
    if get_origin(annotation) is Annotated:
        yield from _parts(annotation.__origin__)
    elif _is_union(annotation):
        for part in get_args(annotation):
            yield from _parts(part)
    else:
        yield annotation


def _metas(annotation: Any) -> Iterator[Meta]:
    """What is said of a type, from the inside."""
    if get_origin(annotation) is Annotated:
        yield from _metas(annotation.__origin__)
        yield from (each for each in annotation.__metadata__ if isinstance(each, Meta))
    elif _is_union(annotation):
        for part in get_args(annotation):
            yield from _metas(part)


def _extra(annotation: Any) -> dict[str, Any]:
    return {
        name: value for meta in _metas(annotation) for name, value in (meta.extra or {}).items()
    }


def _sources(parameter: _Parameter) -> tuple[Any, ...]:
    """The functions and records whose options `**others` stands for."""
    is_rest = parameter.kind is _Parameter.VAR_KEYWORD
    return getattr(parameter.annotation, "__metadata__", ()) if is_rest else ()


def options_of(source: Any) -> dict[str, Option]:
    """The options of a function or record, by its parameters' names."""
    if isinstance(source, type):
        return {key.field: Option(key, is_of_record=True) for key in keys_of(source)}
    doc = inspect.getdoc(source) or ""
    help_of = {name: " ".join(text.split()) for name, text in _ARGUMENT.findall(doc)}
    own, others, made = dict[str, Option](), dict[str, Option](), dict[str, Option]()
    for each in inspect.signature(source).parameters.values():
        name, annotation, extra = each.name, each.annotation, _extra(each.annotation)
        default = NODEFAULT if each.default is _Parameter.empty else each.default
        if get_origin(annotation) is Callable:  # for Python alone
            continue
        if maker := extra.get("made_by"):
            made = options_of(maker)
            main = made.pop(name)
            is_argument = each.kind is _Parameter.POSITIONAL_ONLY
            usual = NODEFAULT if main.key.default is None else main.key.default
            default = usual if default is NODEFAULT else default
            key = main.key._replace(default=default)
            own[name] = main._replace(key=key, is_argument=is_argument)
            continue
        if each.kind is _Parameter.VAR_KEYWORD:
            for inner in _sources(each):
                others |= {n: o for n, o in options_of(inner).items() if n not in others}
            continue
        words = [meta.description for meta in _metas(annotation) if meta.description]
        takes_all = each.kind is _Parameter.VAR_POSITIONAL
        key = Key(name, name, annotation, default, help_of.get(name) or " ".join(words[-1:]), extra)
        is_argument = takes_all or each.kind is _Parameter.POSITIONAL_ONLY
        own[name] = Option(key, is_argument, takes_all=takes_all)
    for name, option in own.items():
        if name in others and not option.key.help:  # it means the same there
            own[name] = option._replace(key=option.key._replace(help=others[name].key.help))
    return own | {name: o for name, o in (others | made).items() if name not in own}


def bound(source: Any, given: Mapping[str, Any], taken: Set[str] = frozenset()) -> dict[str, Any]:
    """Arguments of a function, or fields of a record, from what options give, but those taken."""
    if isinstance(source, type):
        return {key.field: given[key.field] for key in keys_of(source) if key.field in given}
    found = dict[str, Any]()
    parameters = inspect.signature(source).parameters.values()
    names = taken | {each.name for each in parameters}
    for each in parameters:
        if each.name in taken:
            continue
        if maker := _extra(each.annotation).get("made_by"):
            if (made := maker(**bound(maker, given))) is not None:
                found[each.name] = made
        elif each.kind is not _Parameter.VAR_KEYWORD:
            found |= {each.name: given[each.name]} if each.name in given else {}
        elif sources := _sources(each):
            for inner in sources:
                found |= bound(inner, given, names)
        else:
            found |= {name: value for name, value in given.items() if name not in names}
    return found


def _call(function: Callable[..., Any], **options: Any) -> None:
    """Call a function with what options give; what it returns, if anything, is the exit code."""
    given = {name: value for name, value in options.items() if value not in (None, ())}
    found = bound(function, given)
    positional: list[Any] = []
    for each in inspect.signature(function).parameters.values():
        if each.name in found and each.kind is _Parameter.POSITIONAL_ONLY:
            positional.append(found.pop(each.name))
        elif each.kind is _Parameter.VAR_POSITIONAL:
            positional += found.pop(each.name, ())
    if code := function(*positional, **found):
        raise SystemExit(int(code))


class Command(click.Command):
    """A function as a command; its options are made when they are needed."""

    def __init__(self, name: str, function: Callable[..., Any], example: str):
        self._function = function
        super().__init__(
            name, callback=partial(_call, function), epilog=f"Example: jbrep {example}"
        )
        self.help = self._text()

    def _text(self) -> str:
        """The docstring of the function, or else of the one that its options are of."""
        rest = [
            s for p in inspect.signature(self._function).parameters.values() for s in _sources(p)
        ]
        docs = (inspect.getdoc(each) for each in (self._function, *rest))
        return _SECTIONS.sub("", next(filter(None, docs)))

    def options(self) -> Iterable[click.Parameter]:
        """Its options and arguments, those that must be given first."""
        options = options_of(self._function)
        names = {name: each.name for name, each in options.items()}
        self.help = _with_options(self._text(), names)
        in_order = sorted(options.values(), key=lambda each: each.key.default is not NODEFAULT)
        return [each.parameter(names) for each in in_order]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        if not self.params:
            self.params = [*self.options(), _import_option()]
        return super().get_params(ctx)

    def invoke(self, ctx: click.Context) -> Any:
        """Call the function; messages speak of the options that this command has."""
        try:
            return super().invoke(ctx)
        except InputError as error:
            error.args = (with_its_options(str(error), ctx),)
            raise

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Let options that may be repeated take several values at once: --latent 12 8 4.

        Not where there are arguments, for which those values could be meant.
        """
        parameters = self.get_params(ctx)
        repeated = {
            name
            for each in parameters
            if isinstance(each, click.Option) and each.multiple
            for name in each.opts
        }
        if any(isinstance(each, click.Argument) for each in parameters):
            return super().parse_args(ctx, args)
        spread: list[str] = []
        for i, arg in enumerate(args):
            follows = i > 1 and not arg.startswith("-") and not args[i - 1].startswith("-")
            name = next((a for a in reversed(args[:i]) if a.startswith("-")), None)
            spread += [name, arg] if follows and name in repeated else [arg]
        return super().parse_args(ctx, spread)


def _with_options(text: str, options: Mapping[str, str]) -> str:
    """Text that speaks of options by the names that are typed, in place of `parameter`."""
    return re.sub(r"`(\w+)`", lambda found: options.get(found[1], found[0]), text)


def with_its_options(text: str, ctx: click.Context | None) -> str:
    """A message of a function, which speaks of `parameters`, as one of the command."""
    options = ctx.command.get_params(ctx) if ctx else []
    return _with_options(text, {each.name: each.opts[0] for each in options if each.name})


def _import_code(names: Iterable[str]) -> None:
    """Import the modules of names such as mymodule:MyEncoder."""
    if named := [name for name in names if ":" in name]:
        from jbrep.envs.names import import_code
        from jbrep.records.storage import exists

        for name in named:
            if not exists(name):
                import_code(name)


def _import_option() -> click.Option:
    def load(context: click.Context, option: click.Parameter, modules: tuple[str, ...]) -> None:
        if modules := (*_project_modules(), *modules):
            from jbrep.envs.names import import_modules

            import_modules(modules)

    return click.Option(
        ["--import"],
        multiple=True,
        metavar="MODULE",
        envvar="JBREP_IMPORT",
        expose_value=False,
        is_eager=True,  # it takes effect before the command begins
        callback=load,
        help="Import a module that registers environments; this runs its code.",
    )


def _project_modules() -> list[str]:
    """What `import` in [tool.jbrep] names, in the nearest pyproject.toml that has it.

    It is looked for from the working folder up to the repository's, if that is in one.
    """
    try:
        here = Path.cwd()
    except OSError:  # it was deleted
        return []
    above = [here, *here.parents]
    top = next((i for i, folder in enumerate(above) if (folder / ".git").exists()), 0)
    for folder in above[: top + 1]:
        if (file := folder / "pyproject.toml").is_file():
            from jbrep.records.document import read_toml

            modules = None
            with suppress(LookupError, TypeError):  # it has no such table
                modules = read_toml(file)["tool"]["jbrep"]["import"]
            if modules:
                sys.path.append(str(folder))
                return converted(modules, list[str], f"import in [tool.jbrep] of {file}")
    return []


def parse_pairs(given: Iterable[str], option: str = "--env") -> dict[str, Any]:
    """Arguments from an option's NAME=VALUE; values are JSON, True, False, None, or text."""
    arguments: dict[str, Any] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier() or name in arguments:
            raise InputError(f"{option} {pair} isn't an argument, or repeats one: write NAME=VALUE")
        try:
            arguments[name] = json.loads(with_zeros(value))
        except (ValueError, RecursionError):
            arguments[name] = {"True": True, "False": False, "None": None}.get(value, value)
    return arguments


# what a shell completes, by the names of parameters


def _shipped(context: click.Context) -> Iterable[str]:
    """Encoders of the task that stands before, or else of all."""
    from jbrep.encoders.shipped import names
    from jbrep.jitterbug.tasks import TASKS

    given = context.params.get("task")
    tasks = [TASKS[given]] if given in TASKS else TASKS.values()
    return sorted({name for task in tasks for name in names(task.describe())})


def _completing(names: Callable[[click.Context], Iterable[str]]) -> Callable[..., list[str]]:
    def complete(context: click.Context, option: click.Parameter, typed: str) -> list[str]:
        return [name for name in names(context) if name.startswith(typed)]

    return complete


_COMPLETE = {
    "task": _completing(lambda context: import_module("jbrep.jitterbug.tasks").TASKS),
    "kind": _completing(lambda context: import_module("jbrep.methods.kinds").KINDS),
    "encoder": _completing(_shipped),
}
