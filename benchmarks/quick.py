"""What a command costs before it works: --help, importing jbrep, and mistakes in words.

CPU seconds of a process, the least of three, against limits that a machine with busy cores keeps,
too. No mistake in words may import torch.
"""

import subprocess
import sys
from collections.abc import Sequence

from timing import cpu_of_children

_JBREP = ("-m", "jbrep")
LIMITS: dict[Sequence[str], float] = {  # of Python's arguments [s]
    ("-c", "import jbrep"): 0.4,
    (*_JBREP, "--help"): 0.6,
    (*_JBREP, "rl", "--task", "face_direction", "--steps", "-5", "--out", "x"): 0.6,
    (*_JBREP, "rl", "--task", "fly", "--out", "x"): 1.5,
    (*_JBREP, "rl", "--task", "face_direction", "--encoder", "fly", "--out", "x"): 1.5,
    (*_JBREP, "collect", "--task", "fly", "--steps", "10", "--out", "x"): 1.5,
    (*_JBREP, "evaluate", "--encoder", "dae-8", "--data", "nothing"): 1.5,
    (*_JBREP, "evaluate-policy", "nothing"): 1.5,
    (*_JBREP, "inspect", "nothing"): 1.5,
    (*_JBREP, "report", "nothing"): 0.6,
}


def cpu_seconds(command: Sequence[str]) -> float:
    before = cpu_of_children()
    subprocess.run([sys.executable, *command], capture_output=True, check=False)
    return cpu_of_children() - before


def main() -> None:
    slow = False
    for command, limit in LIMITS.items():
        took = min(cpu_seconds(command) for _ in range(3))
        slow |= took > limit
        words = " ".join(command[1:])
        print(f"{words:60} {took:5.2f} s (at most {limit} s)" + " SLOW" * (took > limit))
    sys.exit(slow)


if __name__ == "__main__":
    main()
