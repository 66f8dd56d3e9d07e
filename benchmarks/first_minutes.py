"""What somebody waits for who tries jbrep: make demo, jbrep evaluate, and jbrep rl.

    python benchmarks/first_minutes.py

In a fresh clone, with its own environment; wall time, and CPU time of all processes. Nothing else
should run.
"""

import os
import resource
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent.parent
JBREP = ".venv/bin/jbrep"
ENCODERS = "dae-12", "dae-8", "forward-8", "pca-8"


def timed(what: str, command: Sequence[str], folder: Path) -> None:
    """Run a command, and print how long it took."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, cwd=folder, capture_output=True, check=True)
    after, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{what:50} {seconds:6.0f} s {cpu:8.0f} s of CPU", flush=True)


def main() -> None:
    print(f"{os.cpu_count()} cores")
    with TemporaryDirectory() as name:
        folder = Path(name) / "jbrep"
        subprocess.run(["git", "clone", "--quiet", ROOT, folder], check=True)
        timed("make demo, with its installation", ["make", "demo"], folder)
        given = ["--task", "face_direction", "--seed", "1"]
        collect = [JBREP, "collect", *given, "--steps", "100k", "--out", "data"]
        timed("jbrep collect, 100,000 steps", collect, folder)
        evaluate = [JBREP, "evaluate", "--data", "data", "--encoder", *ENCODERS]
        timed("jbrep evaluate, four encoders, 100,000 rows", evaluate, folder)
        learn = [JBREP, "rl", *given, "--steps", "50k", "--out", "run"]
        timed("jbrep rl, 50,000 steps and evaluations", learn, folder)


if __name__ == "__main__":
    main()
