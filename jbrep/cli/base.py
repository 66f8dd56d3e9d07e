"""The command line itself: its commands, what they print, and how mistakes are shown."""

import errno
import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar, cast

import click

from jbrep.cli.generator import Command, with_its_options
from jbrep.cli.signals import leave
from jbrep.errors import InputError, Notice
from jbrep.text import noted, printable, terminal_width, wrapped

_Function = TypeVar("_Function", bound=Callable[..., Any])

RESUMES = "the same command resumes it"
_ORDER = (  # of work
    *("env", "check", "collect", "data", "train-dae", "train-encoder", "evaluate", "encoder"),
    *("rl", "clone", "policies", "policy", "evaluate-policy"),
    *("study", "report", "inspect", "render", "doctor"),
)
_GROUPS = {
    "data": "Inspect, derive, import and export data sets.",
    "encoder": "Look at encoders, export and import them.",
    "policy": "Export a trained policy for a robot.",
}


class _Mistake(click.ClickException):
    exit_code = 2

    def __init__(self, message: str):
        super().__init__(printable(message))


@contextmanager
def _notices() -> Iterator[None]:
    """Show each notice on standard error."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, Notice):
            text = with_its_options(str(message), click.get_current_context(silent=True))
            say(noted(text), err=True)
        else:
            usual(message, category, *where, **options)

    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        warnings.showwarning = show
        yield


@contextmanager
def _own_output() -> Iterator[None]:
    """Keep standard output for jbrep: what an environment's C code prints there is an error's."""
    try:
        is_usual = (sys.stdout.fileno(), sys.stderr.fileno()) == (1, 2)
    except (AttributeError, OSError, ValueError):
        is_usual = False
    if not is_usual:
        yield
        return
    before, sys_before, kept = sys.stdout, sys.__stdout__, os.dup(1)
    before.flush()
    os.dup2(2, 1)
    own = os.fdopen(kept, "w", encoding=before.encoding, errors=before.errors)
    own.reconfigure(line_buffering=own.isatty())
    sys.stdout = sys.__stdout__ = own  # type: ignore[misc]
    try:
        yield
    finally:
        with suppress(OSError, ValueError):  # such as a pipe that nobody reads
            own.flush()
        os.dup2(kept, 1)
        sys.stdout, sys.__stdout__ = before, sys_before  # type: ignore[misc]
        with suppress(OSError, ValueError):
            own.close()


@contextmanager
def _closing() -> Iterator[None]:
    """Close every environment at the end, also where SIGTERM is the end: it may be a robot."""
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        if instances := sys.modules.get("jbrep.envs.make"):  # only if there may be any
            instances.close_all()


class _Cli(click.Group):
    """A user's mistake is one line and exit code 2; anything else shows its traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(self.commands, key=_ORDER.index)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands: with the options, a terminal of 24 lines wouldn't hold them."""
        self.format_commands(ctx, formatter)

    def main(self, *args: Any, **options: Any) -> Any:
        with _own_output(), _notices(), _closing():
            return super().main(*args, **options)

    def invoke(self, ctx: click.Context) -> None:
        try:
            super().invoke(ctx)
        except InputError as error:
            raise _Mistake(str(error)) from None
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG):
                raise
            raise _Mistake(f"{error}: free some space, or choose another name") from None
        except click.exceptions.NoArgsIsHelpError:
            raise  # of a group, whose help it shows
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx else "jbrep"
            message = error.format_message()
            stop = "" if message.endswith((".", "?")) else "."
            raise _Mistake(f"{message}{stop} See {command} --help.") from None
        except ModuleNotFoundError as error:
            from jbrep.doctor import extra_with

            extra = extra_with(error.name or "")
            if extra is None:
                raise
            raise _Mistake(f"this needs {error.name}: pip install 'jbrep[{extra}]'") from None


@click.group(
    cls=_Cli,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Reduced-order representations of robots, and what they do to learning. Each command's "
    "--help has an example.",
)
@click.version_option(package_name="jbrep")
def main() -> None:
    """The command line."""


def command(example: str, kind: type[Command] = Command) -> Callable[[_Function], _Function]:
    """Make a command of a function, see `jbrep.cli.generator`, which stays as it is.

    Args:
        example: for its help; the first word is the command's name, or a group's and the second
            one the command's.
        kind: of command.
    """
    words = example.split()
    group: click.Group = main
    if words[0] in _GROUPS:
        name = words.pop(0)
        group = click.Group(name, help=_GROUPS[name], epilog=f"Example: jbrep {example}")
        group = cast(click.Group, main.commands.setdefault(name, group))

    def add(function: _Function) -> _Function:
        group.add_command(kind(words[0], function, example))
        return function

    return add


def say(text: str, err: bool = False) -> None:
    """Print lines as `printable` makes them.

    A reader that has seen enough, as `head` has, is no error: the work goes on.
    """
    try:
        click.echo("\n".join(map(printable, text.split("\n"))), err=err)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), (sys.stderr if err else sys.stdout).fileno())


def tell(line: str, err: bool = False) -> None:
    """Print a line wrapped at the terminal's edge: one that has no path to copy."""
    say(wrapped(printable(line), terminal_width()), err=err)


def say_json(value: Any) -> None:
    """Print plain dictionaries, lists, numbers and texts as JSON."""
    say(json.dumps(value, indent=2, allow_nan=False))
