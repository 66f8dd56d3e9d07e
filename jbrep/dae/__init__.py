"""The paper's autoencoder: its settings, its loss and its gradient."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.dae.autoencoder import AE, DAE

__all__ = ["AE", "DAE"]

__getattr__, __dir__ = exports(__name__, {"AE": "autoencoder", "DAE": "autoencoder"})
