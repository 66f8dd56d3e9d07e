"""Kill commands, fill their disk, run them twice at once and damage what they read or left.

Each must end whole, or refuse in a line, and come to the same when it is run again. Everything
happens in forks of this process, which has imported what they need, and itself trains nothing: a
fork of a process in which torch has threads may wait for them for ever.
"""

import errno
import hashlib
import itertools
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jbrep.cli import main
from jbrep.errors import InputError


def a_bit_flipped(content, random):
    bit, damaged = int(random.integers(8 * len(content))), bytearray(content)
    damaged[bit // 8] ^= 1 << bit % 8
    return f"bit {bit}", bytes(damaged)


SYNCS = ("fsync", "replace", "rename", "link")  # each is a point where a command can end
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Surface:
    """What is attacked."""

    act: Callable[[Path], Any]  # makes something in a folder
    result: Callable[[Path], Any]  # what it made, which is the same each time
    # damages: the files, what reads them, and what that gives
    files: Callable[[Path], list[Path]] = lambda folder: []
    read: Callable[[Path], Any] | None = None
    prepare: Callable[[Path], Any] = lambda folder: None


@dataclass
class Tally:
    """What came of attacks, and those that weren't met as they must be."""

    counts: Counter = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)

    def note(self, attack, outcome, fault=""):
        self.counts[f"{attack}: {outcome}"] += 1
        if fault:
            self.faults.append(f"{attack}: {fault}")


def command(*arguments):
    """Run a command as a stranger types it."""
    main([*map(str, arguments)], prog_name="jbrep", standalone_mode=True)


def forked(act, folder, *, before=lambda: None, seconds=None):
    """Do something in a fork, to be killed after so many seconds; its exit code and its words."""
    child, told = _start(act, folder, before)
    if seconds is not None:
        time.sleep(seconds)
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    return _end(child, told)


def _start(act, folder, before=lambda: None, name="told"):
    told = folder.with_suffix(f".{name}")
    told.touch()
    child = os.fork()
    if not child:
        code = 1
        with suppress(BaseException):
            code = _in_child(act, folder, before, told)
        os._exit(code)
    return child, told


def _end(child, told):
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), told.read_text(errors="replace")


def _in_child(act, folder, before, told):
    descriptor = os.open(told, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for standard in (1, 2):
        os.dup2(descriptor, standard)
    os.environ["TQDM_DISABLE"] = "1"
    try:
        before()
        act(folder)
    except SystemExit as error:
        return error.code or 0
    except InputError as error:
        os.write(2, f"Error: {error}\n".encode())
        return 2
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in _FULL:
            return 2  # of a function in Python; commands put it into a line
        os.write(2, traceback.format_exc().encode())
        return 1
    return 0


def at_each_sync(do):
    """Do this before each point of synchronisation."""

    def before():
        for name in SYNCS:
            call = getattr(os, name)

            def noted(*arguments, call=call, **keywords):
                do()
                return call(*arguments, **keywords)

            setattr(os, name, noted)

    return before


def at_sync(number, do):
    """Do this before one of them, counted from 1."""
    numbers = itertools.count(1)
    return at_each_sync(lambda: next(numbers) == number and do())


def _die():
    os.kill(os.getpid(), signal.SIGKILL)


def _disk_is_full():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def limited(size):
    """No file may have more bytes than this, whoever writes it."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def in_one_line(told):
    """Whether a refusal has its line, perhaps after notes and results."""
    lines = told.splitlines()
    return "Traceback" not in told and any(line.startswith("Error: ") for line in lines[-1:])


class Attacker:
    """Attacks a surface, in folders of its own."""

    def __init__(self, surface: Surface, folder: Path, seed: Sequence[int]):
        self.surface, self.folder, self.tally = surface, folder, Tally()
        self.random = np.random.default_rng(seed)
        self._number = 0
        self.peace = self._new()
        self._import_what_it_imports()
        self.expected = surface.result(self.peace)

    def _import_what_it_imports(self):
        """Do it once in peace; import its modules here, or every fork does, in seconds."""
        names = self.folder / "modules"

        def act(folder):
            try:
                self.surface.act(folder)
            finally:
                names.write_text("\n".join(sys.modules))

        code, told = forked(act, self.peace)
        assert code == 0, told
        for name in names.read_text().split():
            with suppress(ImportError):  # some have no file
                import_module(name)

    def _new(self):
        folder = self.folder / f"{self._number:05d}"
        self._number += 1
        folder.mkdir(parents=True)
        self.surface.prepare(folder)
        return folder

    @cached_property
    def measured(self):
        """How often it comes to a point of synchronisation, and how long it takes [s]."""
        folder, points, begun = self._new(), self.folder / "points", time.monotonic()
        with points.open("ab", buffering=0) as file:
            mark = at_each_sync(lambda: file.write(b"."))
            assert forked(self.surface.act, folder, before=mark)[0] == 0
        return points.stat().st_size, time.monotonic() - begun

    def _some_points(self, most):
        """Numbers of points of synchronisation, at most so many."""
        every = np.arange(self.measured[0]) + 1
        return sorted(self.random.permutation(every)[:most].tolist())

    def kills(self, count):
        """At points of synchronisation, every one where there are few, and at any time."""
        for number in self._some_points(count):
            folder = self._new()
            code, _ = forked(self.surface.act, folder, before=at_sync(number, _die))
            self.again("killed at a sync", folder, code)
        for _ in range(count // 2):
            folder = self._new()
            wait = self.random.uniform(0, self.measured[1])
            code, _ = forked(self.surface.act, folder, seconds=wait)
            self.again("killed at any time", folder, code)

    def full_disks(self, count):
        """An error at a point of synchronisation, and files that can't grow."""
        numbers = self._some_points(count)
        ways = [("full at a sync", at_sync(number, _disk_is_full)) for number in numbers]
        there, prepared = self.peace, self._new()  # what is there before needn't grow
        largest = max(
            path.stat().st_size
            for path in there.rglob("*")
            if path.is_file() and not (prepared / path.relative_to(there)).exists()
        )
        # from some 1,000 bytes on: what the command says is in a file, too
        sizes = np.exp(self.random.uniform(7, np.log(largest), count // 2))
        ways += [("files can't grow", limited(int(size))) for size in sizes]
        for attack, before in ways:
            folder = self._new()
            code, told = forked(self.surface.act, folder, before=before)
            if code not in (0, 2) or (code == 2 and told and not in_one_line(told)):
                self.tally.note(attack, code, f"exit code {code}: {told[-600:]}")
            else:
                self.again(attack, folder, code)

    def together(self, count):
        """Two at once: each does its work or says why not, and one result is there."""
        for _ in range(count):
            folder = self._new()
            children = [_start(self.surface.act, folder, name=name) for name in ("a", "b")]
            codes = []
            for child in children:
                code, words = _end(*child)
                codes.append(code)
                if code not in (0, 2) or (code == 2 and not in_one_line(words)):
                    self.tally.note("two at once", code, f"exit code {code}: {words[-400:]}")
            same = 0 in codes and self.surface.result(folder) == self.expected
            self.tally.note("two at once", sorted(codes), "" if same else "another result, or none")

    def damages(self, count):
        """Damage a file that is read: it is refused in a line, or nothing changes."""
        surface = self.surface
        assert surface.read is not None
        expected = surface.read(self.peace)
        files = surface.files(self.peace)
        sizes = np.array([path.stat().st_size for path in files], float)
        for _ in range(count):
            # small files count as much as large ones, half of the time
            weights = sizes / sizes.sum() if self.random.random() < 0.5 else None
            path = files[self.random.choice(len(files), p=weights)]
            content = path.read_bytes()
            where, damaged = a_bit_flipped(content, self.random)
            path.write_bytes(damaged)
            try:
                outcome = "no harm" if surface.read(self.peace) == expected else "other data"
            except (InputError, SystemExit) as error:
                outcome = "refused" if "\n" not in str(error) else "refused in several lines"
            except Exception as error:
                outcome = f"failed: {type(error).__name__}: {error}"
            finally:
                path.write_bytes(content)
            is_met = outcome in ("no harm", "refused")
            fault = "" if is_met else f"{where} of {path.name}: {outcome}"
            self.tally.note("a bit flipped", outcome.partition(":")[0], fault)


def attack(surface, folder, *, kills=0, full=0, twice=0, flips=0, seed=(0,)):
    """Attack in each way so many times, in a new folder; the tally."""
    attacker = Attacker(surface, folder, seed)
    for way, count in (
        (attacker.kills, kills),
        (attacker.full_disks, full),
        (attacker.together, twice),
    ):
        if count:
            way(count)
    if flips and surface.read:
        told = attacker.folder / "damages"
        code, words = forked(lambda _: _note_damages(attacker, flips, told), attacker.peace)
        assert code == 0, words
        damages = json.loads(told.read_text())
        attacker.tally.counts.update(damages["counts"])
        attacker.tally.faults += damages["faults"]
    return attacker.tally


def _note_damages(attacker, flips, path):
    attacker.tally = Tally()
    attacker.damages(flips)
    path.write_text(json.dumps(vars(attacker.tally)))


def digest(*paths):
    """Of files, by their names."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
