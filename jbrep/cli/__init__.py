"""The command line: a table of Python functions, and what is printed of their results."""

from jbrep.cli import data, encoders, policies, rl, study, train, view
from jbrep.cli.base import main

__all__ = ["data", "encoders", "main", "policies", "rl", "study", "train", "view"]
