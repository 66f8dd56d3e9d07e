"""Statistics over runs: does a smaller state help? The run is the unit of replication."""

from jbrep.stats.analysis import Analysis, analyse
from jbrep.stats.runs import RunCurve

__all__ = ["Analysis", "RunCurve", "analyse"]
