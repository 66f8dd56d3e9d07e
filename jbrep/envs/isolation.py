"""Keeps an environment's changes to the process to itself.

An environment may change the working directory, torch's default type, the filters of warnings and
other global state. Each side finds its own again.
"""

import ctypes
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import cache
from io import TextIOBase
from typing import Any, NamedTuple

import numpy as np

from jbrep.errors import STEP_TIMEOUT, StoppedProcess, kind_and_line


class _Global(NamedTuple):
    """Something that a process has once."""

    get: Callable[[], Any]  # it as plain data, which can be compared
    put: Callable[[Any], object]


def _directory() -> str | None:
    with suppress(OSError):  # it may be deleted
        return os.getcwd()  # noqa: PTH109, Path.cwd takes ten times as long
    return None


def _put_directory(path: str | None) -> None:
    if path is not None:
        os.chdir(path)


def _put_variables(variables: dict[bytes, bytes]) -> None:
    there = os.environb
    for name in there.keys() - variables.keys():
        del there[name]
    there.update(variables)


def _put_filters(filters: list[Any]) -> None:
    warnings.filters[:] = filters  # type: ignore[index]
    warnings._filters_mutated()  # type: ignore[attr-defined]


def _put_interrupt(handler: Any) -> None:
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)


_GENERATOR: Any = np.random.mtrand._rand._bit_generator  # NumPy's global one
_STATE_BYTES = 2500  # of MT19937: 624 words, and the place among them


_SLOW = {
    "variables": _Global(lambda: dict(os.environb), _put_variables),
    "what Ctrl-C does": _Global(lambda: signal.getsignal(signal.SIGINT), _put_interrupt),
}
_QUICK = {
    "the working directory": _Global(_directory, _put_directory),
    "filters of warnings": _Global(lambda: [*warnings.filters], _put_filters),
    "NumPy's errors": _Global(np.geterr, lambda how: np.seterr(**how)),
    "NumPy's generator": _Global(  # cheaply: NumPy makes a dictionary of it
        lambda: ctypes.string_at(_GENERATOR.ctypes.state_address, _STATE_BYTES),
        lambda state: ctypes.memmove(_GENERATOR.ctypes.state_address, state, _STATE_BYTES),
    ),
    "the limit of recursion": _Global(sys.getrecursionlimit, sys.setrecursionlimit),
}


@cache
def _globals(in_episode: bool, torch: Any) -> dict[str, _Global]:
    """What is looked at, with torch if that is imported."""
    known = _QUICK if in_episode else _QUICK | _SLOW
    if torch is None:
        return known
    return known | {
        "torch's type": _Global(torch.get_default_dtype, torch.set_default_dtype),
        "torch's gradients": _Global(torch.is_grad_enabled, torch.set_grad_enabled),
        "torch's threads": _Global(torch.get_num_threads, torch.set_num_threads),
        "torch's generator": _Global(
            lambda: torch.get_rng_state().numpy().tobytes(),
            lambda state: torch.set_rng_state(
                torch.frombuffer(bytearray(state), dtype=torch.uint8)
            ),
        ),
    }


def _open_output() -> None:
    """Let no file of jbrep's get the number of an output that was closed."""
    try:
        os.fstat(1)
    except OSError:
        with suppress(OSError):
            os.dup2(2, 1)


class _ToErrors(TextIOBase):
    """Standard error, which an environment can't close."""

    def write(self, text: str) -> int:
        return sys.stderr.write(text) if sys.stderr else len(text)

    def flush(self) -> None:
        if sys.stderr:
            sys.stderr.flush()

    def close(self) -> None:
        """Leave it open."""


@contextmanager
def in_time() -> Iterator[None]:
    """Let what takes longer than `STEP_TIMEOUT` says fail, if that is said."""
    seconds = float(os.environ.get(STEP_TIMEOUT, 0))
    if not seconds or threading.current_thread() is not threading.main_thread():
        yield
        return

    def fail(*_signal: Any) -> None:
        raise TimeoutError(f"it hasn't come back within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


OURS = (KeyboardInterrupt, StoppedProcess)  # which no environment raises
_OUTPUT = _ToErrors()
_environment_state: dict[str, Any] = {}  # what environments have changed, as they left it
_inside = False


@contextmanager
def isolated(in_episode: bool = False) -> Iterator[None]:
    """Let an environment do what it does: what it changes is put back, what it prints is an error.

    Args:
        in_episode: whether it is stepped, where what is slow to look at waits for the next episode.

    Raises:
        RuntimeError: it wants to end the process, or the like, in place of what it raised.
    """
    global _inside
    if _inside:
        yield
        return
    torch = sys.modules.get("torch")  # which may only just be being imported
    every = _globals(in_episode, torch if hasattr(torch, "get_rng_state") else None)
    jbrep_state = {name: each.get() for name, each in every.items()}
    for name in _environment_state.keys() & every.keys():
        every[name].put(_environment_state[name])
    _inside = True
    try:
        with redirect_stdout(_OUTPUT):
            yield
    except (Exception, *OURS):
        raise
    except BaseException as error:
        raise RuntimeError(f"it raised {kind_and_line(error)}") from error
    finally:
        _inside = False
        _open_output()
        for name, each in every.items():
            now = each.get()
            if name in _environment_state or now != jbrep_state[name]:
                _environment_state[name] = now
                each.put(jbrep_state[name])
