"""Encoders: from observations to latents and back, their file format, and those that ship."""

from jbrep.encoders.encoder import Encoder, load, save
from jbrep.encoders.header import FULL
from jbrep.encoders.layers import ACTIVATIONS, Layer
from jbrep.encoders.shipped import find

__all__ = ["ACTIVATIONS", "FULL", "Encoder", "Layer", "find", "load", "save"]
