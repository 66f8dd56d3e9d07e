"""Reports: a study's tables as a page, summaries and figures."""

from jbrep.report.report import make_report, write_report

__all__ = ["make_report", "write_report"]
