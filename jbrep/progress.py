"""Progress of long work: a bar on a terminal, a line now and then in a log."""

import sys
from contextlib import suppress
from typing import Any, TextIO

from tqdm import tqdm

_LOG_EVERY = 30.0  # seconds between two lines where there is no terminal
_NOTEBOOK = "ipykernel.iostream"  # the module of what is standard error there
_LOG_LINE = "{desc}: {n_fmt} of {total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"


def is_live() -> bool:
    """Whether a line on standard error can be written over: on a terminal, or in a notebook."""
    stream = sys.stderr
    return stream is not None and (stream.isatty() or type(stream).__module__ == _NOTEBOOK)


class Progress(tqdm):
    """tqdm on standard error: a bar where it is live, lines elsewhere, nothing where it is closed.

    It takes tqdm's arguments. What `initial` counts was done before, so the rate and the time left
    come from the rest.
    """

    def __init__(self, *args: Any, **options: Any):
        if sys.stderr is None:
            options |= {"disable": True}
        elif not is_live():
            options |= {"file": _Log(sys.stderr), "bar_format": _LOG_LINE, "leave": False}
            options |= {"mininterval": _LOG_EVERY, "delay": _LOG_EVERY, "miniters": 1}
        super().__init__(*args, **options)

    def set_postfix(self, *args: Any, refresh: bool = False, **values: Any) -> None:
        """What stands behind the rate, from the next time on that anything is shown.

        With refresh that is at once, if it is a bar.
        """
        super().set_postfix(*args, refresh=refresh and is_live(), **values)


class _Log:
    """A stream that tqdm's bars are written to as lines: nothing returns to a line's start."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> None:
        with suppress(OSError):  # whoever read it may have gone
            if line := text.strip():
                self._stream.write(f"{line}\n")

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()
