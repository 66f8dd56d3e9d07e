"""What Ctrl-C and SIGTERM do."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

import click

from jbrep.errors import StoppedProcess

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPING = b"\nstopping: writing a checkpoint, within seconds; Ctrl-C again ends at once\n"


def leave(number: int, frame: FrameType | None) -> NoReturn:
    """End the process as the signal would, with what is to be done at its end."""
    raise StoppedProcess(128 + number)


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
    with on_stop(leave):
        try:
            yield
        except SystemExit:
            click.echo(f"stopped; {afterwards}", err=True)
            raise


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """The signals received so far, Ctrl-C or SIGTERM; the second ends the process at once."""
    received: list[int] = []

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for each in STOP_SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        if sys.stderr is not None:  # written directly: Python's streams may be in use right now
            with suppress(OSError, ValueError):
                os.write(sys.stderr.fileno(), _STOPPING)

    with on_stop(receive):
        yield received
