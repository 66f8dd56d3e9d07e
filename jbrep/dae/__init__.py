"""The paper's autoencoder: its settings, its loss and its gradient."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.dae.autoencoder import AE as AE
    from jbrep.dae.autoencoder import DAE as DAE

__getattr__, __dir__, __all__ = exports(__name__)
