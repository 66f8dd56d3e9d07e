"""Reports: a study's tables as a page, summaries and figures."""

from jbrep.report.report import write_report

__all__ = ["write_report"]
