"""Train encoders of every kind for some tasks, and compare them.

python tools/encoders.py DATA ENCODERS RESULTS TASK...; existing encoders are kept. Without a task
it only prints the overview of RESULTS.
"""

import json
import sys
from pathlib import Path
from typing import Any

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.encoders import FULL
from jbrep.evaluate.files import write
from jbrep.evaluate.summary import evaluation_text
from jbrep.figures import encoder_plots
from jbrep.figures import write as write_plots
from jbrep.methods.autoencoder import NOISE
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import read_name

LATENTS = (12, 8, 4)
STEMS = ("dae", "dae-deep", "ae", "pca", "random", "untrained", "untrained-deep")


def compare(data: ScaledDataset, encoders: Path, results: Path) -> None:
    """Make encoders of all kinds for a task; write evaluation.json, tables.txt and the figures."""
    fitter = Fitter(data, encoders)
    recipes = [read_name(f"{stem}-{latent}") for stem in STEMS for latent in LATENTS]
    fitted = [fitter.fit(method.name, **given).encoder for method, given in recipes]
    evaluation = write({encoder.name: encoder for encoder in fitted}, data, results)
    (results / "tables.txt").write_text(evaluation_text(evaluation) + "\n")
    write_plots(encoder_plots(evaluation), results)
    print(evaluation_text(evaluation))


def overview(results: Path) -> str:
    """A table by task: error as a multiple of PCA's, and at noise 0.1 of the best linear code's."""
    files = sorted(results.glob("*/evaluation.json"))
    tasks = {file.parent.name: json.loads(file.read_text())["encoders"] for file in files}
    names = [n for n in dict.fromkeys(n for e in tasks.values() for n in e) if n != FULL]
    lines = [f"| | {' | '.join(tasks)} |", "|---" * (len(tasks) + 1) + "|"]
    for name in names:
        cells = [_cell(encoders[name]) if name in encoders else "-" for encoders in tasks.values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(encoder: dict[str, Any]) -> str:
    noisy = next(level for level in encoder["corruption"] if level["noise"] == NOISE)
    clean = encoder["reconstruction"]["ratio_to_pca"][0]
    return f"{clean:.2f}, {noisy['mse'][0] / noisy['linear_mse'][0]:.2f}"


if __name__ == "__main__":
    data, encoders, results, *tasks = sys.argv[1:]
    for task in tasks:
        scaled = ScaledDataset(Dataset(Path(data, task)))
        compare(scaled, Path(encoders, task), Path(results, task))
    print(overview(Path(results)))
