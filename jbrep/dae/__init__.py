"""The paper's autoencoder: its settings, its loss and its gradient."""

from jbrep.dae.autoencoder import AE as AE
from jbrep.dae.autoencoder import DAE as DAE
