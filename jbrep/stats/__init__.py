"""Statistics over runs: does a smaller state help? The run is the unit of replication."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.stats.analysis import Analysis as Analysis
    from jbrep.stats.analysis import analyse as analyse
    from jbrep.stats.runs import RunCurve as RunCurve

__getattr__, __dir__, __all__ = exports(__name__)  # they import scipy.stats
