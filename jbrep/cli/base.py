"""What the commands share: how mistakes are shown, options, numbers as people write them."""

import errno
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import click

from jbrep.cli.output import lasting_output, say, tell
from jbrep.cli.signals import leave
from jbrep.errors import InputError, Notice
from jbrep.text import printable

_Command = TypeVar("_Command", bound=Callable[..., Any])


class _Count(click.ParamType[int]):
    """A whole number as people write it: 5000000, 5_000_000, 5e6, 5M, 5k."""

    name = "number"

    def __init__(self, least: int | None = None):
        self._least = least

    def convert(
        self, value: str | int, param: click.Parameter | None, ctx: click.Context | None
    ) -> int:
        number = self._number(value)
        if self._least is not None and number < self._least:
            self.fail(f"{value!r} is too small: it must be at least {self._least}")
        return number

    def _number(self, value: str | int) -> int:
        text = str(value).replace("_", "").lower()
        factor = {"k": 1_000, "m": 1_000_000}.get(text[-1:], 1)
        digits = text[:-1] if factor > 1 else text
        try:
            number = Decimal(digits) * factor
        except ArithmeticError:
            number = Decimal("nan")
        if not (number.is_finite() and abs(number) < _TOO_LARGE and number == int(number)):
            self.fail(f"{value!r} isn't a whole number: write it as 5000000, 5_000_000, 5e6 or 5M")
        return int(number)


_TOO_LARGE = 10**18
COUNT, POSITIVE = _Count(), _Count(least=1)
_FULL = (errno.ENOSPC, errno.EDQUOT)
RESUMES = "the same command resumes it"


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
            line = f"Note: {message}"
            (say if os.sep in line else tell)(line, err=True)  # a path may be copied
        else:
            usual(message, category, *where, **options)

    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        warnings.showwarning = show
        yield


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


class Cli(click.Group):
    """A user's mistake is one line and exit code 2; anything else shows its traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order of work."""
        return list(self.commands)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands: with the options, a terminal of 24 lines wouldn't hold them."""
        self.format_commands(ctx, formatter)

    def main(self, *args: Any, **options: Any) -> Any:
        """Run the command line; close what it has opened."""
        with lasting_output(), _notices(), _closing():
            return super().main(*args, **options)

    def invoke(self, ctx: click.Context) -> None:
        """Run a command."""
        try:
            super().invoke(ctx)
        except InputError as error:
            raise _Mistake(str(error)) from None
        except OSError as error:  # of what writes files in its own way, as TensorBoard does
            if mistake := _mistake_of(error):
                raise mistake from None
            raise
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


def _mistake_of(error: OSError) -> _Mistake | None:
    """What the system refuses as a user's mistake, if it is one."""
    what = f" {error.filename}" if error.filename else ""
    if error.errno in _FULL:
        return _Mistake(
            f"can't write{what}: {os.strerror(error.errno)}; free some space, then run the same "
            "command again"
        )
    if error.errno == errno.ENAMETOOLONG:
        return _Mistake(f"can't use{what}: {os.strerror(error.errno).lower()}; choose another")
    return None


class Variadic(click.Command):
    """An option that may be repeated also takes several values at once: --latent 12 8 4."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the option's name before each of its values."""
        repeatable = {
            name
            for option in self.get_params(ctx)
            if isinstance(option, click.Option) and option.multiple
            for name in option.opts
        }
        spread: list[str] = []
        for i, arg in enumerate(args):
            follows = i > 1 and not arg.startswith("-") and not args[i - 1].startswith("-")
            name = next((a for a in reversed(args[:i]) if a.startswith("-")), None)
            spread += [name, arg] if follows and name in repeatable else [arg]
        return super().parse_args(ctx, spread)


def with_options(*several: Callable[[_Command], _Command]) -> Callable[[_Command], _Command]:
    """A decorator that gives a command several options, in this order."""

    def decorate(command: _Command) -> _Command:
        for option in reversed(several):
            command = option(command)
        return command

    return decorate


PATH = click.Path(path_type=Path)
data_option = click.option("--data", required=True, type=PATH, help="A folder from jbrep collect.")
as_json = click.option("--json", "as_json", is_flag=True, help="As JSON, for programs.")
