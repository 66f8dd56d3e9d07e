"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from jbrep.evaluate.evaluation import evaluate

__all__ = ["evaluate"]
