"""Make encoders by all methods for some tasks, evaluate them, and put the chosen ones in place.

python tools/encoders.py DATA ENCODERS RESULTS TASK...; DATA, ENCODERS and RESULTS have a folder for
each task. What is there already is kept, and what ships is used as it is, so that the same command
resumes. Without a task it only prints the overview of RESULTS. See --help.
"""

import argparse
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.encoders import FULL, load
from jbrep.encoders.encoder import SUFFIX
from jbrep.encoders.shipped import UNLEARNED
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.evaluation.evaluation import EVALUATION, Diagnostics, Evaluation
from jbrep.evaluation.table import DIAGNOSTICS, Diagnosed, diagnostics_text, headline
from jbrep.methods.fit import Fitter
from jbrep.methods.registry import get_method, name_of
from jbrep.records.document import read_document
from jbrep.records.tables import write_text
from jbrep.reporting.diagnostics import evaluated
from jbrep.reporting.evaluation import evaluation_text

SHIPPED = Path(__file__).parent.parent / "jbrep" / "encoders" / "shipped"
SIZES = (12, 8, 4)
MADE: tuple[tuple[str, dict[str, Any], tuple[int, ...]], ...] = (
    ("dae", {}, SIZES),
    ("pca", {}, SIZES),
    ("random", {}, SIZES),
    ("slow", {}, SIZES),
    ("vamp", {}, SIZES),
    ("linear-forward", {}, SIZES),
    ("forward", {}, SIZES),
    ("self-prediction", {}, (8,)),
    ("deepmdp", {}, (8,)),
    ("dae", {"architecture": "deep"}, (8,)),
    ("ae", {}, (8,)),
    ("ddae", {}, (8,)),
    ("vae", {}, (8,)),
    ("lld-vae", {}, (8,)),
    ("untrained", {}, (8,)),
    ("untrained", {"architecture": "deep"}, (8,)),
)


def names_and_settings(kinds: list[str]) -> dict[str, tuple[str, Any]]:
    """Kind and settings of each encoder, by its name."""
    made = [
        (kind, {**settings, "latent": latent})
        for kind, settings, sizes in MADE
        for latent in sizes
        if not kinds or kind in kinds
    ]
    names = [name_of(get_method(kind).of(settings)) for kind, settings in made]
    return dict(zip(names, made, strict=True))


def make(data: ScaledDataset, folder: Path, wanted: dict[str, tuple[str, Any]]) -> list[Path]:
    """The files of the encoders: those that ship, among them coordinates, and those made."""
    fitter, there = Fitter(data, folder), SHIPPED / data.task.slug
    ours = {name: there / f"{name}{SUFFIX}" for name in wanted}
    missing = {name: how for name, how in wanted.items() if not ours[name].exists()}
    for name, (kind, settings) in missing.items():  # every mistake shows before the first training
        fitter.plan(kind, name=name, **settings)
    fitted = {
        name: fitter.fit(kind, name=name, **how).path for name, (kind, how) in missing.items()
    }
    unlearned = (there / f"{name}{SUFFIX}" for name in UNLEARNED if name != FULL)
    return [
        *(fitted.get(name, ours[name]) for name in wanted),
        *(file for file in unlearned if file.exists()),
    ]


def evaluate(files: list[Path], data: Path, results: Path) -> None:
    """Write evaluation.json, tables.txt and the figures, unless they are of these encoders."""
    hashes = {load(file).fingerprint for file in files}
    if not is_current(results / EVALUATION, hashes):
        (results / EVALUATION).unlink(missing_ok=True)
        options = ("--encoder", *map(str, files), "--data", str(data), "--out", str(results))
        subprocess.run([sys.executable, "-m", "jbrep", "evaluate", *options], check=True)
    text = evaluation_text(read_document(results / EVALUATION, Evaluation), 100, True)
    (results / "tables.txt").write_text(text + "\n")


def is_current(path: Path, hashes: set[str]) -> bool:
    """Whether an evaluation is of these encoders, by all diagnostics that there are now."""
    try:
        return {*read_document(path, Evaluation).hashes.values()} == hashes
    except InputError:
        return False


def ship(task: Task, files: list[Path], kinds: list[str], results: Path) -> None:
    """Copy the encoders of some kinds to those that ship, and write what is known of all there.

    Nothing ships for a task that has no folder.
    """
    folder = SHIPPED / task.slug
    if not folder.is_dir():
        return
    for file in files:
        if load(file).kind in kinds and not (folder / file.name).exists():
            shutil.copy(file, folder)
    known = evaluated(results / EVALUATION)
    rows = []
    for file in sorted(folder.glob(f"*{SUFFIX}")):
        name, sha256 = file.stem, load(file).fingerprint
        if values := known.get((task.name, FULL if name == FULL else sha256)):
            rows.append(Diagnosed(task.name, name, sha256, values))
    write_text(folder / DIAGNOSTICS, diagnostics_text(rows))


def overview(results: Path) -> str:
    """A table by task: R² of the change of what is rewarded, and error over PCA's."""
    files = sorted(results.glob(f"*/{EVALUATION}"))
    tasks = {file.parent.name: read_document(file, Evaluation).encoders for file in files}
    lines = [f"| | {' | '.join(tasks)} |", "|---" * (len(tasks) + 1) + "|"]
    for name in dict.fromkeys(name for encoders in tasks.values() for name in encoders):
        cells = [_cell(encoders[name]) if name in encoders else "-" for encoders in tasks.values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(known: Diagnostics) -> str:
    told = headline(known)
    shown = [told.get(name) for name in ("rewarded", "times_pca")]
    return ", ".join(f"{value:.2f}" for value in shown if value is not None) or "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for folder in ("data", "encoders", "results"):
        parser.add_argument(folder, type=Path)
    parser.add_argument("tasks", nargs="*")
    parser.add_argument("--only", nargs="+", default=[], help="kinds to make; all by default")
    parser.add_argument("--ship", nargs="+", default=[], help="kinds to put among what ships")
    given = parser.parse_args()
    os.nice(10)  # it takes hours
    wanted = names_and_settings(given.only)
    for task in given.tasks:
        data, results = given.data / task, given.results / task
        scaled = ScaledDataset(Dataset(data))
        files = make(scaled, given.encoders / task, wanted)
        evaluate(files, data, results)
        ship(scaled.task, files, given.ship, results)
    print(overview(given.results))


if __name__ == "__main__":
    main()
