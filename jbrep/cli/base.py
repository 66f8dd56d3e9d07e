"""What the commands share: how mistakes are shown, Ctrl-C, numbers as people write them."""

import _thread
import errno
import json
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO, TypeVar

import click

from jbrep.errors import InputError, Notice
from jbrep.text import terminal_width, wrapped

_Command = TypeVar("_Command", bound=Callable[..., Any])


@contextmanager
def lasting_output() -> Iterator[None]:
    """Let a command finish its work whatever becomes of its output.

    A reader that has seen enough, as `head` has, is no error. Output that is lost for want of
    space is told on standard error once the work is done, and ends the command with code 1.
    """
    _open_standard_descriptors()
    streams = sys.stdout, sys.stderr
    out, err = _Lasting(sys.stdout), _Lasting(sys.stderr)
    sys.stdout, sys.stderr = out, err
    try:
        yield
    except SystemExit as ending:
        out.flush()
        if out.is_incomplete and not ending.code:
            err.write(f"Error: can't write the output: {os.strerror(out.error)}\n")
            raise SystemExit(1) from None
        raise
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = streams


def _open_standard_descriptors() -> None:
    """Fill those that are closed, or else the next files to be opened would take their places."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free one


class _Lasting:
    """A text stream that goes quiet at the first error.

    Attributes:
        error: the number of that error; 0 before it.
    """

    def __init__(self, stream: TextIO | None):
        self._stream: Any = stream or open(os.devnull, "w")  # noqa: PTH123, SIM115
        self.error = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @property
    def is_incomplete(self) -> bool:
        """Whether something is missing of what a reader still waits for."""
        return self.error not in (0, errno.EPIPE)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError as error:
            self._silence(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._silence(error)

    def _silence(self, error: OSError) -> None:
        """Send what is still buffered, and all that follows, nowhere."""
        self.error = self.error or error.errno or errno.EIO
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


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
        if digits.isdecimal():
            return int(digits) * factor
        try:
            number = float(digits) * factor
        except ValueError:
            number = math.nan
        if not number.is_integer():
            self.fail(f"{value!r} isn't a whole number: write it as 5000000, 5_000_000, 5e6 or 5M")
        return int(number)


COUNT, POSITIVE = _Count(), _Count(least=1)
_FULL = (errno.ENOSPC, errno.EDQUOT)
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
RESUMES = "the same command resumes it"


class _Mistake(click.ClickException):
    exit_code = 2

    def __init__(self, message: str):
        super().__init__(printable(message))


def printable(line: str) -> str:
    """The line without characters that could control a terminal, as names of files may hold."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def say(line: str, err: bool = False) -> None:
    """Print a line as `printable` makes it."""
    click.echo(printable(line), err=err)


def tell(line: str, err: bool = False) -> None:
    """Print a line as `say` does, wrapped at the terminal's edge: one that has no path to copy."""
    click.echo(wrapped(printable(line), terminal_width()), err=err)


def echo_text(text: str) -> None:
    """Print several lines, each as `printable` makes it."""
    for line in text.splitlines():
        say(line)


@contextmanager
def on_stop(handle: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Install a handler of Ctrl-C and SIGTERM, and put back those before at the end."""
    before = [signal.signal(number, handle) for number in STOP_SIGNALS]
    try:
        yield
    finally:
        for number, handler in zip(STOP_SIGNALS, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def stoppable(afterwards: str) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the command, with a line on what follows from that."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    def repeat(dropped: "sys.UnraisableHookArgs") -> None:
        """Send the signal again: Python drops what is raised while an object is destroyed."""
        if isinstance(stopped := dropped.exc_value, SystemExit) and isinstance(stopped.code, int):
            threading.Timer(0.1, _thread.interrupt_main, [stopped.code - 128]).start()
        else:
            usual(dropped)

    usual, sys.unraisablehook = sys.unraisablehook, repeat
    with on_stop(stop):
        try:
            yield
        except SystemExit:
            click.echo(f"stopped; {afterwards}", err=True)
            raise
        finally:
            sys.unraisablehook = usual


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
        signal.signal(signal.SIGTERM, _leave)
    try:
        yield
    finally:
        if instances := sys.modules.get("jbrep.envs.instances"):  # only if there may be any
            instances.close_all()


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


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
            raise _mistake_of(error) from None
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


def _mistake_of(error: OSError) -> Exception:
    """What the system refuses as a user's mistake if it is one; else the error itself."""
    what = f" {error.filename}" if error.filename else ""
    if error.errno in _FULL:
        return _Mistake(
            f"can't write{what}: {os.strerror(error.errno)}; free some space, then run the same "
            "command again"
        )
    if error.errno == errno.ENAMETOOLONG:
        return _Mistake(f"can't use{what}: {os.strerror(error.errno).lower()}; choose another")
    return error


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


def echo_json(value: Any) -> None:
    """Print plain dictionaries, lists, numbers and texts as JSON."""
    click.echo(json.dumps(value, indent=2, allow_nan=False))


def echo_paths(paths: Iterable[Path]) -> None:
    """Print where files are, after an empty line."""
    click.echo("\n" + "\n".join(printable(str(path)) for path in paths))
