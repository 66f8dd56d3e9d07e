"""Statistics over runs: does a smaller state help? The run is the unit of replication."""

from jbrep.stats.analysis import Analysis, analyse
from jbrep.stats.runs import RunCurve
from jbrep.stats.summary import statistics_text

__all__ = ["Analysis", "RunCurve", "analyse", "statistics_text"]
