"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.evaluate.evaluation import diagnose

__all__ = ["diagnose"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jbrep.evaluate import evaluation  # imports scikit-learn, which statistics do without

    return getattr(evaluation, name)
