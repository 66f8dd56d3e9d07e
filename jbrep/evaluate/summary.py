"""An evaluation as tables to read on a screen."""

import textwrap
from collections.abc import Mapping
from typing import Any

from jbrep.encoders import FULL
from jbrep.text import interval, number, table

_NOISE = 0.1  # the level of corruption that is shown


def evaluation_text(evaluation: Mapping[str, Any], width: int | None = None) -> str:
    """What encoders lose and what their latents keep, a line for each encoder.

    Args:
        evaluation: as `jbrep.evaluate.diagnose` returns it.
        width: columns to fit; None for lines as long as they come.
    """
    data, encoders = evaluation["data"], evaluation["encoders"]
    parts = (
        f"Error on {data['test_episodes']:,} held-out episodes of {data['task']} "
        f"({data['test_rows']:,} rows), features scaled to [-1, 1], with 95 % intervals over "
        "episodes",
        _losses(encoders, width),
        "What can be read from the latent: R² of linear probes; KNN-MSE (2: nothing); GTC (1: the "
        "units are the state itself); R² of the next latent, whitened",
        _readings(encoders, width),
        "Latent units: dead ones, the most saturated one, participation ratio, intrinsic dimension",
        _units(encoders, width),
    )
    texts, tables = parts[::2], parts[1::2]
    wrapped = texts if width is None else [textwrap.fill(text, width) for text in texts]
    return "\n\n".join(part for pair in zip(wrapped, tables, strict=True) for part in pair)


def _losses(encoders: Mapping[str, Any], width: int | None) -> str:
    header = ("encoder", "l", "error", "times PCA's", f"from noise {_NOISE}", "best linear")
    rows = []
    for label, diagnostics in encoders.items():
        if label == FULL:
            continue
        lost = diagnostics["reconstruction"]
        ratio = lost["ratio_to_pca"]
        noisy = next(c for c in diagnostics["corruption"] if c["noise"] == _NOISE)
        worst = min(lost["features"], key=lambda f: (f["r2"][0] is None, f["r2"][0]))
        rows.append(
            (
                label,
                str(diagnostics["latent"]),
                interval(lost["mse"], ".5f"),
                interval(ratio, ".3f") if ratio else "-",
                number(noisy["mse"][0], ".5f"),
                number(noisy["linear_mse"][0], ".5f"),
                f"{worst['name']} {number(worst['r2'][0], '.2f')}",
            )
        )
    return table((*header, "worst feature, R²"), rows, width)


def _readings(encoders: Mapping[str, Any], width: int | None) -> str:
    probes = list(encoders[FULL]["probes"])
    header = ("encoder", *(name.replace("_", " ") for name in probes), "KNN-MSE", "GTC", "next")
    rows = [
        (
            label,
            *(number(diagnostics["probes"][name][0], ".2f") for name in probes),
            number(diagnostics["neighbours"]["mse"][0], ".2f"),
            number(diagnostics["correlation"]["mean"][0], ".2f"),
            number(diagnostics["dynamics"]["linear"][0], ".2f"),
        )
        for label, diagnostics in encoders.items()
    ]
    return table(header, rows, width)


def _units(encoders: Mapping[str, Any], width: int | None) -> str:
    rows = []
    for label, diagnostics in encoders.items():
        units = diagnostics["latent_units"]
        saturated = max(units["saturation"]) if units["saturation"] else None
        estimates = units["intrinsic_dimension"]
        rows.append(
            (
                label,
                str(len(units["dead"])),
                number(saturated, ".0%"),
                number(units["participation_ratio"], ".1f"),
                number(estimates["two_nn"], ".1f"),
                number(estimates["mle"], ".1f"),
            )
        )
    header = ("encoder", "dead", "saturated", "participation", "TwoNN", "max. likelihood")
    return table(header, rows, width)
