"""An evaluation as tables to read on a screen."""

from typing import Any

from jbrep.encoders import FULL
from jbrep.text import interval, number, table

_NOISE = 0.1  # the corruption to show


def evaluation_text(evaluation: dict[str, Any]) -> str:
    """What is lost, and what the latent keeps, an encoder to a line."""
    data = evaluation["data"]
    return "\n".join(
        (
            f"Error on {data['test_episodes']:,} held-out episodes of {data['task']}, "
            f"{data['test_rows']:,} rows; features scaled to [-1, 1], 95 % intervals over episodes",
            "",
            _losses(evaluation["encoders"]),
            "",
            "What can be read: R^2 of linear probes; KNN-MSE (2: nothing); GTC (1: units show the "
            "state itself); R^2 of the next latent, whitened",
            "",
            _readings(evaluation["encoders"]),
            "",
            "Units: dead, the most saturated one, participation ratio, intrinsic dimension",
            "",
            _units(evaluation["encoders"]),
        )
    )


def _losses(encoders: dict[str, Any]) -> str:
    header = ("encoder", "l", "error", "times PCA's", f"from noise {_NOISE}", "best linear")
    rows = []
    for label, found in encoders.items():
        if label == FULL:
            continue
        lost = found["reconstruction"]
        ratio = lost["ratio_to_pca"]
        noisy = next(c for c in found["corruption"] if c["noise"] == _NOISE)
        worst = min(lost["features"], key=lambda f: (f["r2"][0] is None, f["r2"][0]))
        rows.append(
            (
                label,
                str(found["latent"]),
                interval(lost["mse"], ".5f"),
                interval(ratio, ".3f") if ratio else "-",
                number(noisy["mse"][0], ".5f"),
                number(noisy["linear_mse"][0], ".5f"),
                f"{worst['name']} {number(worst['r2'][0], '.2f')}",
            )
        )
    return table((*header, "worst feature, R^2"), rows)


def _readings(encoders: dict[str, Any]) -> str:
    probes = list(encoders[FULL]["probes"])
    header = ("encoder", *(name.replace("_", " ") for name in probes), "KNN", "GTC", "next")
    rows = [
        (
            label,
            *(number(found["probes"][name][0], ".2f") for name in probes),
            number(found["neighbours"]["mse"][0], ".2f"),
            number(found["correlation"]["mean"][0], ".2f"),
            number(found["dynamics"]["linear"][0], ".2f"),
        )
        for label, found in encoders.items()
    ]
    return table(header, rows)


def _units(encoders: dict[str, Any]) -> str:
    rows = []
    for label, found in encoders.items():
        units = found["latent_units"]
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
    return table(header, rows)
