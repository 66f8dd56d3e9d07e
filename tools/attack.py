"""Kill commands, fill their disk, run two at once and flip bits: python tools/attack.py 100.

It prints what came of it, and ends with code 1 where something false came of an attack.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from jbrep.opengl import prepare_opengl

HELPERS = Path(__file__).resolve().parent.parent / "tests" / "helpers"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "times",
        nargs="?",
        type=int,
        default=20,
        help="attacks of each surface in each way, 20 if not given; ten times as many bits are "
        "flipped in the files that it reads, and a quarter as many pairs run at once",
    )
    parser.add_argument(
        "surfaces",
        nargs="*",
        metavar="surface",
        help="what to attack, such as report or 'import of csv'; everything if not given",
    )
    given = parser.parse_args()
    if given.times < 1:
        parser.error(f"times is {given.times}: it must be at least 1")
    sys.path.insert(0, str(HELPERS))
    os.environ["OMP_NUM_THREADS"] = "1"  # a fork waits for ever for threads that it hasn't got
    prepare_opengl()  # before MuJoCo is imported
    from surfaces import SURFACES

    if unknown := [name for name in given.surfaces if name not in SURFACES]:
        parser.exit(2, f"unknown surface {unknown[0]!r}: choose from {', '.join(SURFACES)}\n")
    sys.exit(bool(attack_all(dict.fromkeys(given.surfaces or SURFACES), given.times)))


def attack_all(names: Iterable[str], times: int) -> int:
    """Attack surfaces so many times in each way; the number of faults, each of which is printed."""
    from attacks import attack
    from surfaces import SURFACES, Shared

    faults = 0
    with tempfile.TemporaryDirectory() as temporary:
        shared = Shared(Path(temporary) / "shared")
        for name in names:
            surface, begun = SURFACES[name](shared), time.monotonic()
            counts = {"kills": times, "full": times, "twice": times // 4, "flips": 10 * times}
            tally = attack(surface, Path(temporary) / name, **counts, seed=(1, *name.encode()))
            print(f"{name}: {time.monotonic() - begun:.0f} s", flush=True)
            for what, count in sorted(tally.counts.items()):
                print(f"  {count:6} {what}")
            for fault in tally.faults:
                print(f"  FAULT {fault}", flush=True)
            faults += len(tally.faults)
    print(f"{faults} faults")
    return faults


if __name__ == "__main__":
    main()
