"""Statistics over runs: whether a smaller state helps, with a run as the unit of replication."""

from jbrep.stats.analysis import Analysis, analyse
from jbrep.stats.runs import RunCurve
from jbrep.stats.summary import statistics_text

__all__ = ["Analysis", "RunCurve", "analyse", "statistics_text"]
