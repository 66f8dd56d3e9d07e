"""Diagnostics: what encoders lose, what their latents look like, what can be read from them."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jbrep.evaluate.diagnosis import diagnose

__all__ = ["diagnose"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jbrep.evaluate import diagnosis  # imports scikit-learn, which statistics do without

    return getattr(diagnosis, name)
