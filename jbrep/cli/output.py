"""What the commands print, and that it can be lost without harm."""

import errno
import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import click

from jbrep.text import printable, terminal_width, wrapped


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


def echo_json(value: Any) -> None:
    """Print plain dictionaries, lists, numbers and texts as JSON."""
    click.echo(json.dumps(value, indent=2, allow_nan=False))


def echo_paths(paths: Iterable[Path]) -> None:
    """Print where files are, after an empty line."""
    click.echo("\n" + "\n".join(printable(str(path)) for path in paths))
