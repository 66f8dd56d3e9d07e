"""What the benchmarks share: to time work, and to show ratios over rounds taken in turn."""

import resource
import time
from collections.abc import Callable, Sequence

import numpy as np


def timed(work: Callable[[], object]) -> float:
    """Seconds that it takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def cpu_of_children() -> float:
    """CPU seconds of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def show(what: str, values: Sequence[float] | np.ndarray, aim: str = "") -> None:
    """Their median and 10th to 90th percentile, and what they should be."""
    low, median, high = np.percentile(values, (10, 50, 90))
    print(f"{what:72} {median:8.3g}  [{low:.3g}, {high:.3g}]   {aim}", flush=True)
