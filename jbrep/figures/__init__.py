"""Figures, drawn from the tables that the other stages write."""

from jbrep.figures.behaviour import behaviour_plots
from jbrep.figures.encoders import encoder_plots
from jbrep.figures.plot import Plot, write
from jbrep.figures.study import study_plots

__all__ = ["Plot", "behaviour_plots", "encoder_plots", "study_plots", "write"]
