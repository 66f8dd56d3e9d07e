"""What this process may use of its machine: cores and memory, within a container's limits."""

import os
import platform
from contextlib import suppress
from pathlib import Path

_CPU, _CGROUP = Path("/proc/cpuinfo"), Path("/sys/fs/cgroup")
# what a container may use, in version 2 of control groups and in version 1
_LIMITS = "memory.max", "memory/memory.limit_in_bytes"


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
    most = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for limit in _LIMITS:
        with suppress(OSError, ValueError):  # not there, or "max"
            most.append(int((_CGROUP / limit).read_text()))
    return min(most)
