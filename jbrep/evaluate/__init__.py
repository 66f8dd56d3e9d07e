"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.evaluate.diagnosis import diagnose

__all__ = ["diagnose"]

__getattr__, __dir__ = exports(__name__, {"diagnose": "diagnosis"})  # which imports scikit-learn
