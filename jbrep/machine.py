"""What this process may use of its machine: cores and memory, within a container's limits."""

import os
import platform
from contextlib import suppress
from pathlib import Path

_CPU, _MEMORY = Path("/proc/cpuinfo"), Path("/proc/meminfo")
_CGROUP = Path("/sys/fs/cgroup")
_LIMITS = {  # what a container may use, and uses, in version 2 of control groups and in version 1
    "memory.max": "memory.current",
    "memory/memory.limit_in_bytes": "memory/memory.usage_in_bytes",
}


def cores() -> int:
    """How many processes or threads make sense at once."""
    try:
        from joblib import cpu_count  # heeds affinity and a container's limits
    except ModuleNotFoundError:
        return os.cpu_count() or 1
    return int(cpu_count())


def cpu() -> str:
    """The processor's name, where the system tells it."""
    with suppress(OSError):
        for line in _CPU.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory() -> int:
    """Bytes of memory."""
    whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([whole, *(limit for limit, _ in _containers())])


def free_memory() -> int:
    """Bytes that can be had without swapping; all that there are where the system doesn't say."""
    free = [memory(), *(limit - used for limit, used in _containers())]
    with suppress(OSError):
        for line in _MEMORY.read_text().splitlines():
            name, _, kilobytes = line.partition(":")
            if name == "MemAvailable":  # also what only caches files
                free.append(int(kilobytes.split()[0]) << 10)
    return max(min(free), 0)


def _containers() -> list[tuple[int, int]]:
    """Bytes that a container may use at most, and those in use that aren't a cache of files."""
    found = []
    for limit, used in _LIMITS.items():
        with suppress(OSError, ValueError):  # not there, or "max"
            most = int((_CGROUP / limit).read_text())
            found.append((most, int((_CGROUP / used).read_text()) - _cached(_CGROUP / limit)))
    return found


def _cached(limit: Path) -> int:
    for line in limit.with_name("memory.stat").read_text().splitlines():
        name, _, number = line.partition(" ")
        if name == "inactive_file":
            return int(number)
    return 0
