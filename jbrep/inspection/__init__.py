"""Episodes and encoders as Rerun recordings; nothing here opens a viewer."""

from jbrep.inspection.subject import inspect

__all__ = ["inspect"]
