"""Figures, drawn from the tables that the other stages write."""

from jbrep.report.figures.encoders import encoder_plots
from jbrep.report.figures.panels import Plot, write
from jbrep.report.figures.study import study_plots

__all__ = ["Plot", "encoder_plots", "study_plots", "write"]
