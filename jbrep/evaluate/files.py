"""The file of an evaluation."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jbrep.dataset import ScaledDataset
from jbrep.encoders import find
from jbrep.encoders.own import as_file
from jbrep.errors import InputError
from jbrep.evaluate.evaluation import diagnose
from jbrep.evaluate.policy import GoodPolicy
from jbrep.records.storage import exists, make_folder, write_whole
from jbrep.training.trainer import single_torch_thread

EVALUATION = "evaluation.json"
_DIGITS = 6


def write(
    encoders: Mapping[str, Any],
    data: ScaledDataset,
    folder: Path,
    policy: GoodPolicy | None = None,
) -> dict[str, Any]:
    """Evaluate encoders, and write evaluation.json.

    Args:
        encoders: by the label to show; whatever `jbrep.encoders.find` takes.
        data: to judge them on.
        folder: created if it doesn't exist.
        policy: that does the task well, if one is known.

    Returns:
        The evaluation, as `jbrep.evaluate.diagnose` returns it.

    Raises:
        InputError: an encoder was made for other features, or the folder holds the evaluation of
            other encoders or data, or with another policy.
    """
    path = folder / EVALUATION
    judged = {label: find(each, data.task) for label, each in encoders.items()}
    with single_torch_thread():  # as in runs, which know a module by the file that is kept of it
        hashes = {label: as_file(encoder).fingerprint for label, encoder in judged.items()}
    if exists(path):
        wanted = {"data": data.dataset.manifest.fingerprint, "encoders": hashes}
        _check_same(path, {**wanted, "policy": policy and policy.name})
    make_folder(folder)
    evaluation = diagnose(judged, data, policy)
    for label, digest in hashes.items():
        evaluation["encoders"][label]["sha256"] = digest
    write_whole(path, _text(evaluation).encode())
    return evaluation


def _check_same(path: Path, wanted: dict[str, Any]) -> None:
    """Make sure that a repeated evaluation replaces no other one."""
    try:
        there = json.loads(path.read_bytes())
        hashes = {label: e["sha256"] for label, e in there["encoders"].items() if "sha256" in e}
        policy = there.get("policy", wanted["policy"])  # version 1 has none
        made = {"data": there["data"]["fingerprint"], "encoders": hashes, "policy": policy}
        same = made == wanted
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        same = False
    if not same:
        raise InputError(
            f"{path} is not an evaluation of these encoders on this data: choose another --out"
        )


def _text(value: Any) -> str:
    """JSON with each list of numbers on one line."""
    text = json.dumps(_rounded(value), indent=1, allow_nan=False)
    return re.sub(r"\[[-+.,\deEnul\s]*\]", lambda match: " ".join(match[0].split()), text) + "\n"


def _rounded(value: Any) -> Any:
    """The same with all floats in six digits."""
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    if isinstance(value, dict):
        return {name: _rounded(v) for name, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list) else value
