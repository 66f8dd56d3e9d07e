"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from typing import TYPE_CHECKING

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.evaluation.diagnosis import diagnose as diagnose

__getattr__, __dir__, __all__ = exports(__name__)  # it imports scikit-learn
