"""Figures, drawn from the tables that the other stages write."""

from jbrep.reporting.figures.panels import Plot, write
from jbrep.reporting.figures.study import study_plots

__all__ = ["Plot", "study_plots", "write"]
