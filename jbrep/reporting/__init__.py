"""Reports: a study's tables as a page, summaries and figures."""

from jbrep.reporting.report import make_report, write_report

__all__ = ["make_report", "write_report"]
