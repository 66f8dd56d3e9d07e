"""The file that an evaluation is kept in."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jbrep.dataset import ScaledDataset
from jbrep.encoders import Encoder
from jbrep.encoders.file import fingerprint
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import evaluate
from jbrep.files.storage import exists, make_folder, write_whole

EVALUATION = "evaluation.json"
_DIGITS = 6


def write(encoders: Mapping[str, Encoder], data: ScaledDataset, folder: Path) -> dict[str, Any]:
    """Evaluate encoders, and write evaluation.json.

    Args:
        encoders: by the label to show.
        data: to judge them on.
        folder: made if it isn't there.

    Returns:
        The evaluation, as `jbrep.evaluate.evaluate` gives it.

    Raises:
        InputError: an encoder made for other features, or a folder that holds the evaluation of
            other encoders or data.
    """
    path = folder / EVALUATION
    marks = {label: fingerprint(encoder) for label, encoder in encoders.items()}
    if exists(path):
        _check_same(path, {"data": data.dataset.manifest.fingerprint, "encoders": marks})
    make_folder(folder)
    evaluation = evaluate(encoders, data)
    for label, mark in marks.items():
        evaluation["encoders"][label]["sha256"] = mark
    write_whole(path, _text(evaluation).encode())
    return evaluation


def _check_same(path: Path, wanted: dict[str, Any]) -> None:
    """An evaluation is replaced by its own repetition only."""
    try:
        there = json.loads(path.read_bytes())
        marks = {label: e["sha256"] for label, e in there["encoders"].items() if "sha256" in e}
        same = {"data": there["data"]["fingerprint"], "encoders": marks} == wanted
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        same = False
    if not same:
        raise InputError(
            f"{path} holds something else than the evaluation of these encoders on this data: "
            "choose another --out"
        )


def _text(value: Any) -> str:
    """JSON with each list of numbers on one line."""
    text = json.dumps(_rounded(value), indent=1, allow_nan=False)
    return re.sub(r"\[[-+.,\deEnul\s]*\]", lambda found: " ".join(found[0].split()), text) + "\n"


def _rounded(value: Any) -> Any:
    """All numbers in so many digits."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {name: _rounded(v) for name, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list) else value
