"""Episodes, encoders and training curves as Rerun recordings; nothing here opens a viewer."""

from jbrep.inspection.subject import inspect

__all__ = ["inspect"]
