"""Functions run on a Ray cluster."""

import os
from collections.abc import Callable
from typing import Any

from jbrep.pool import ATTEMPTS

_QUIET: dict[str, Any] = {
    "log_to_driver": False,
    "logging_level": "ERROR",
    "include_dashboard": False,
}


def on_cluster(function: Callable[..., Any], cpus: int | None, gpus: int = 0) -> Any:
    """A function as Ray's remote function, on a core each, called again if its node dies.

    Args:
        function: to run.
        cpus: of the local cluster that is started where RAY_ADDRESS names none; None takes all.
        gpus: that it needs.
    """
    import ray

    if not ray.is_initialized():
        ray.init(num_cpus=None if "RAY_ADDRESS" in os.environ else cpus, **_QUIET)
    return ray.remote(num_cpus=1, num_gpus=gpus, max_retries=ATTEMPTS - 1)(function)
