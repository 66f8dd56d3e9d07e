"""An encoder's diagnostics in a few named numbers, for tables and figures of many encoders."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

Entry = Mapping[str, Any]  # of an encoder in evaluation.json
Read = Callable[[Entry], Any]

HORIZON = "10"  # steps ahead that stand for all


class Scalar(NamedTuple):
    """A named number of an encoder's diagnostics.

    Attributes:
        words: what it is, in a few words.
        better: 1 if higher is better, -1 if lower is.
        read: finds [value, low, high] in an encoder's entry of evaluation.json; it may fail, or
            give None, where the entry lacks it.
    """

    words: str
    better: int
    read: Read


def headline(diagnostics: Entry) -> dict[str, list[float | None] | None]:
    """The named numbers of an encoder: [value, low, high], or None where they aren't known.

    Args:
        diagnostics: the encoder's entry of evaluation.json, of any version.
    """
    return {name: _read(scalar, diagnostics) for name, scalar in SCALARS.items()}


def _read(scalar: Scalar, diagnostics: Entry) -> list[float | None] | None:
    try:
        values = scalar.read(diagnostics)
    except (KeyError, TypeError):  # an older file, or None in place of what can't be measured
        return None
    return None if values is None or values[0] is None else list(values)


def _at(*path: str) -> Read:
    def read(diagnostics: Entry) -> Any:
        value: Any = diagnostics
        for name in path:
            value = value[name]
        return value

    return read


def _mean(name: str) -> Read:
    """The mean of R^2 of several quantities, without an interval."""

    def read(diagnostics: Entry) -> list[float | None] | None:
        known = [score[0] for score in diagnostics[name].values() if score[0] is not None]
        return [sum(known) / len(known), None, None] if known else None

    return read


SCALARS = {
    "forward": Scalar(
        "R² of the features' change over 10 steps", 1, _at("prediction", HORIZON, "mean")
    ),
    "rewarded": Scalar(
        "R² of the change over 10 steps of what the reward depends on",
        1,
        _at("prediction", HORIZON, "rewarded"),
    ),
    "reward": Scalar("R² of the mean reward of 10 steps", 1, _at("prediction", HORIZON, "reward")),
    "value": Scalar("R² of a good policy's return to go", 1, _at("value")),
    "action": Scalar("R² of a good policy's action", 1, _at("action", "nonlinear")),
    "forward_1": Scalar(
        "R² of the features' change over 1 step", 1, _at("prediction", "1", "mean")
    ),
    "forward_5": Scalar("the same over 5 steps", 1, _at("prediction", "5", "mean")),
    "forward_20": Scalar("the same over 20 steps", 1, _at("prediction", "20", "mean")),
    "probes": Scalar("mean R² of linear probes of the state", 1, _mean("probes")),
    "nonlinear_probes": Scalar(
        "mean R² of nonlinear probes of the state", 1, _mean("nonlinear_probes")
    ),
    "next": Scalar("R² of the next latent, linear", 1, _at("dynamics", "linear")),
    "knn": Scalar("how unlike states of near latents are (KNN-MSE)", -1, _at("neighbours", "mse")),
    "gtc": Scalar("how directly units show the state (GTC)", 1, _at("correlation", "mean")),
    "error": Scalar("squared error of the reconstruction", -1, _at("reconstruction", "mse")),
    "times_pca": Scalar("that error over PCA's", -1, _at("reconstruction", "ratio_to_pca")),
}
