"""Environments that do one thing that they shouldn't: when they are made, reset or stepped."""

import contextlib
import ctypes
import decimal
import gc
import locale
import multiprocessing
import os
import random
import signal
import sys
import threading
import time
import warnings

import gymnasium
import numpy as np
from gymnasium import spaces

FORTY_TWO = 42


class _NoTextError(Exception):
    def __str__(self):
        raise ValueError("no text")


def _raise(error):
    raise error


def _torch(change):
    if torch := sys.modules.get("torch"):
        change(torch)


def _print_from_c():
    libc = ctypes.CDLL(None)
    libc.puts(b"hello from C")
    libc.fflush(None)


def _close(descriptor):
    with contextlib.suppress(OSError):
        os.close(descriptor)


def _simulator():
    """A process as multiprocessing starts it, which answers."""
    ours, its = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=its.send, args=("ready",))
    process.start()
    assert ours.poll(20)
    process.join()


def _child():
    process = multiprocessing.get_context("fork").Process(target=time.sleep, args=(0,))
    process.start()
    process.join()


HARMLESS = {  # it is played as if nothing had happened
    "directory": lambda: os.chdir("/"),
    "torch type": lambda: _torch(lambda torch: torch.set_default_dtype(torch.float64)),
    "torch gradients": lambda: _torch(lambda torch: torch.set_grad_enabled(False)),
    "torch threads": lambda: _torch(lambda torch: torch.set_num_threads(2)),
    "torch seed": lambda: _torch(lambda torch: torch.manual_seed(FORTY_TWO)),
    "numpy errors": lambda: np.seterr(all="raise"),
    "numpy seed": lambda: np.random.seed(FORTY_TWO),  # noqa: NPY002
    "numpy print": lambda: np.set_printoptions(precision=1, threshold=2),
    "seed": lambda: random.seed(FORTY_TWO),
    "warnings as errors": lambda: warnings.simplefilter("error"),
    "a warning": lambda: warnings.warn("mind the gap", stacklevel=1),
    "variables": lambda: os.environ.update(COLUMNS="7", TQDM_DISABLE="1", HOME="/nowhere"),
    "print": lambda: print("hello"),
    "print from C": _print_from_c,
    "output closed": lambda: sys.stdout.close(),
    "descriptor closed": lambda: _close(1),
    "Ctrl-C ignored": lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    "a thread": lambda: threading.Thread(target=time.sleep, args=(0.01,)).start(),
    "a child": _child,
    "a simulator": _simulator,
    "garbage": gc.disable,
    "decimals": lambda: setattr(decimal.getcontext(), "prec", 2),
    "locale": lambda: locale.setlocale(locale.LC_ALL, "C"),
    "umask": lambda: os.umask(0o777),
    "arguments": lambda: sys.argv.clear(),
    "recursion": lambda: sys.setrecursionlimit(400),
}
FAILS = {  # it is a failure like any other
    "exit": lambda: sys.exit(),
    "exit 0": lambda: sys.exit(0),
    "exit with words": lambda: sys.exit("goodbye\nand thanks"),
    "BaseException": lambda: _raise(BaseException("odd")),
    "GeneratorExit": lambda: _raise(GeneratorExit),
    "StopIteration": lambda: _raise(StopIteration),
    "error without text": lambda: _raise(_NoTextError),
    "error with long text": lambda: _raise(ValueError("a" * 1_000_000)),
    "error of two lines": lambda: _raise(RuntimeError("one\ntwo")),
    "memory": lambda: _raise(MemoryError),
    "no file": lambda: open("/no/such/file"),  # noqa: SIM115, PTH123
    "broken pipe": lambda: _raise(BrokenPipeError("peer has gone")),
    "recursion without end": lambda: _forever(),
    "a stall": lambda: time.sleep(60),
}


def _forever():
    return _forever()


class Odd(gymnasium.Env):
    """A cart that is pushed, and does something odd.

    Args:
        how: a key of `HARMLESS` or `FAILS`; nothing if it is empty.
        when: "make", "reset" or "step", the seventh of each episode.
    """

    observation_space = spaces.Box(-9, 9, (2,), np.float64)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    dt = 0.05

    def __init__(self, how="", when="", render_mode=None):
        self.how, self.when, self.render_mode = how, when, render_mode
        self._maybe("make")

    def _maybe(self, when):
        if self.how and self.when == when:
            {**HARMLESS, **FAILS}[self.how]()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._maybe("reset")
        self.state, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.state.copy(), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 7:
            self._maybe("step")
        place, speed = self.state
        self.state = np.clip([place + 0.05 * speed, speed + 0.1 * float(action[0])], -9, 9)
        return self.state.copy(), -abs(float(place)), False, False, {}

    def render(self):
        return np.full((60, 90, 3), 255, np.uint8)


gymnasium.register("Odd-v0", entry_point=Odd, max_episode_steps=12)
