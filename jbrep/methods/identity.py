"""The observation itself, scaled."""

from jbrep.encoders.encoder import IDENTITY
from jbrep.methods.method import ClosedForm, Made

METHOD = ClosedForm(
    name=IDENTITY, words="the scaled observation itself", make=lambda data, settings: Made((), ())
)
