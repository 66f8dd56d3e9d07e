"""Train encoders of every kind for some tasks, and put them side by side.

python tools/encoders.py DATA ENCODERS RESULTS TASK...; what is there already is kept.
"""

import sys
from pathlib import Path

from jbrep.dae.training import Training
from jbrep.dataset import Dataset, ScaledDataset
from jbrep.evaluate.files import write
from jbrep.evaluate.summary import summary
from jbrep.figures import encoder_figures
from jbrep.fit import Fitter

LATENTS = (12, 8, 4)
KINDS = (
    ("dae", "paper"),
    ("dae", "deep"),
    ("ae", "paper"),
    ("pca", "paper"),
    ("random", "paper"),
    ("untrained", "paper"),
    ("untrained", "deep"),
)


def compare(data: ScaledDataset, encoders: Path, results: Path) -> None:
    """Fit all kinds for a task, and write evaluation.json, tables.txt and the figures."""
    fitter = Fitter(data, encoders)
    fitted = [
        fitter.fit(kind, Training.of(latent, architecture)).encoder
        for kind, architecture in KINDS
        for latent in LATENTS
    ]
    evaluation = write({encoder.name: encoder for encoder in fitted}, data, results)
    (results / "tables.txt").write_text(summary(evaluation) + "\n")
    encoder_figures(evaluation, results)
    print(summary(evaluation))


if __name__ == "__main__":
    data, encoders, results, *tasks = sys.argv[1:]
    for task in tasks:
        scaled = ScaledDataset(Dataset(Path(data, task)))
        compare(scaled, Path(encoders, task), Path(results, task))
