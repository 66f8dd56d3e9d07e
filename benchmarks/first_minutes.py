"""What somebody waits for who tries jbrep: make demo, jbrep evaluate, and jbrep rl.

    python benchmarks/first_minutes.py

In a fresh clone, with its own environment; wall time, and CPU time of all processes. Nothing else
should run.
"""

import os
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from timing import cpu_of_children, timed

ROOT = Path(__file__).parent.parent
JBREP = ".venv/bin/jbrep"
ENCODERS = "dae-12", "dae-8", "forward-8", "pca-8"


def wait(what: str, command: Sequence[str], folder: Path) -> None:
    """Run a command, and print how long it took."""
    before = cpu_of_children()
    run = partial(subprocess.run, command, cwd=folder, capture_output=True, check=True)
    print(f"{what:50} {timed(run):6.0f} s {cpu_of_children() - before:8.0f} s of CPU", flush=True)


def main() -> None:
    print(f"{os.cpu_count()} cores")
    with TemporaryDirectory() as name:
        folder = Path(name) / "jbrep"
        subprocess.run(["git", "clone", "--quiet", ROOT, folder], check=True)
        wait("make demo, with its installation", ["make", "demo"], folder)
        given = ["--task", "face_direction", "--seed", "1"]
        collect = [JBREP, "collect", *given, "--steps", "100k", "--out", "data"]
        wait("jbrep collect, 100,000 steps", collect, folder)
        evaluate = [JBREP, "evaluate", "--data", "data", "--encoder", *ENCODERS]
        wait("jbrep evaluate, four encoders, 100,000 rows", evaluate, folder)
        learn = [JBREP, "rl", *given, "--steps", "50k", "--out", "run"]
        wait("jbrep rl, 50,000 steps and evaluations", learn, folder)


if __name__ == "__main__":
    main()
