"""A grid of runs, from a TOML file or from Python: prepared, run side by side, registered."""

from jbrep.stats.rules import Rules
from jbrep.studies.config import Data, Study, read_study
from jbrep.studies.plan import Plan
from jbrep.studies.runner import register_study, run_study

__all__ = ["Data", "Plan", "Rules", "Study", "read_study", "register_study", "run_study"]
