"""An evaluation as tables to read on a screen."""

import sys
import textwrap
from collections.abc import Mapping
from typing import Any

from jbrep.encoders import FULL
from jbrep.evaluate.headline import headline
from jbrep.evaluate.truth import in_words
from jbrep.text import facts, interval, number, r2_text, table

_SERVES = {  # of the headline
    "forward": "the features' change over 10 steps, from code and actions",
    "rewarded": "of that, what the reward depends on",
    "reward": "the mean reward of these steps",
    "value": "the discounted return to go",
    "action": "the action",
}
_OF_POLICY = ("value", "action")
_NOISE = 0.1  # the level of corruption that is shown
_MANY = 8  # quantities from which probes are summed up


def evaluation_text(evaluation: Mapping[str, Any], width: int | None = None) -> str:
    """What encoders lose and what their latents keep, a line for each encoder.

    Args:
        evaluation: as `jbrep.evaluate.diagnose` returns it.
        width: columns to fit; None for lines as long as they come.
    """
    data, encoders = evaluation["data"], evaluation["encoders"]
    parts = (
        *_headline(evaluation, width),
        f"Error on {data['test_episodes']:,} held-out episodes of {data['task']} "
        f"({data['test_rows']:,} rows), features scaled to [-1, 1], with 95 % intervals over "
        "episodes",
        _losses(encoders, width),
        "What can be read from the latent: R² of linear probes; KNN-MSE (2: nothing); GTC (1: the "
        f"units are the state itself{_drawn(encoders)}); R² of the next latent, whitened",
        _readings(encoders, width),
        "Latent units: dead ones, the most saturated one, participation ratio, intrinsic dimension",
        _units(encoders, width),
    )
    texts, tables = parts[::2], parts[1::2]
    wrapped = texts if width is None else [textwrap.fill(text, width) for text in texts]
    return "\n\n".join(part for pair in zip(wrapped, tables, strict=True) for part in pair)


def _headline(evaluation: Mapping[str, Any], width: int | None) -> tuple[str, ...]:
    """What tells codes that serve from others, and a line on what each loses; of version 2."""
    if "needs" not in evaluation:
        return ()
    encoders, policy = evaluation["encoders"], evaluation["policy"]
    shown = {name: words for name, words in _SERVES.items() if policy or name not in _OF_POLICY}
    scalars = {label: headline(diagnostics) for label, diagnostics in encoders.items()}
    rows = [
        (label, str(encoders[label]["latent"]), *(_first(known[name]) for name in shown))
        for label, known in scalars.items()
    ]
    explained = "; ".join(f"{name}: {words}" for name, words in shown.items())
    return (
        f"Whether a controller can work with the code: held-out R², nonlinear (1: all, 0: nothing)."
        f" {explained[0].upper()}{explained[1:]}{f' of {policy}' if policy else ''}",
        table(("encoder", "l", *shown), rows, width),
        "What a controller needs and the code loses (R² of reading it below .5), the most needed "
        "first",
        _lost(evaluation, width),
    )


def _first(values: list[float | None] | None) -> str:
    return r2_text(None if values is None else values[0])


def _lost(evaluation: Mapping[str, Any], width: int | None) -> str:
    task, lines = evaluation["data"]["task"], {}
    for label, diagnostics in evaluation["encoders"].items():
        lost: dict[str, float] = {}
        for each in diagnostics["loses"]:
            lost.setdefault(in_words(task, each["name"]), each["kept"])
        more = len(lost) - _MANY
        some = [f"{words} ({r2_text(kept)})" for words, kept in list(lost.items())[:_MANY]]
        lines[label] = ", ".join(some) + (f" and {more} more" if more > 0 else "") or "nothing"
    return facts(lines, width or sys.maxsize, indent=0)


def _losses(encoders: Mapping[str, Any], width: int | None) -> str:
    header = ("encoder", "l", "error", "times PCA's", f"from noise {_NOISE}", "best linear")
    rows = []
    for label, diagnostics in encoders.items():
        if label == FULL:
            continue
        lost = diagnostics["reconstruction"]
        if lost is None:
            rows.append((label, str(diagnostics["latent"]), *["-"] * (len(header) - 1)))
            continue
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
                f"{worst['name']} {r2_text(worst['r2'][0])}",
            )
        )
    return table((*header, "worst feature, R²"), rows, width)


def _drawn(encoders: Mapping[str, Any]) -> str:
    """How many dimensions of the state the GTC looks at, if not at all."""
    gtc = encoders[FULL]["correlation"]
    judged, whole = len(gtc["dimensions"]), gtc.get("state_dimensions")
    return f"; {judged} of its {whole} dimensions" if whole and judged < whole else ""


def _readings(encoders: Mapping[str, Any], width: int | None) -> str:
    probes = {label: _probes(diagnostics["probes"]) for label, diagnostics in encoders.items()}
    header = ("encoder", *probes[FULL], "KNN-MSE", "GTC", "next")
    rows = [
        (
            label,
            *probes[label].values(),
            number(diagnostics["neighbours"]["mse"][0], ".2f"),
            number(diagnostics["correlation"]["mean"][0], ".2f"),
            r2_text(diagnostics["dynamics"]["linear"][0]),
        )
        for label, diagnostics in encoders.items()
    ]
    return table(header, rows, width)


def _probes(scores: Mapping[str, Any]) -> dict[str, str]:
    """R² of each quantity; of many, of those that vary, the mean and the least."""
    if len(scores) <= _MANY:
        return {name.replace("_", " "): r2_text(score[0]) for name, score in scores.items()}
    known = {name: score[0] for name, score in scores.items() if score[0] is not None}
    if not known:
        return {"probes, mean": "-", "worst probe": "-"}
    worst = min(known, key=known.__getitem__)
    return {
        "probes, mean": r2_text(sum(known.values()) / len(known)),
        "worst probe": f"{worst} {r2_text(known[worst])}",
    }


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
