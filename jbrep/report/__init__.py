"""A study's tables as a page, a summary and figures to look at."""

from jbrep.report.report import write_report

__all__ = ["write_report"]
