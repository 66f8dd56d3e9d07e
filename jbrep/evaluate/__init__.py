"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.evaluate.evaluation import evaluate

__all__ = ["evaluate"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jbrep.evaluate import evaluation  # brings scikit-learn, which no statistics need

    return getattr(evaluation, name)
