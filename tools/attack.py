"""Kill commands, fill their disk, run two at once and flip bits: python tools/attack.py 100.

Each surface is attacked so many times in each way, and files that it reads are damaged ten times as
often; or those alone that are named after the number. It prints what came of it, and ends with code
1 where something false came of an attack.
"""

import sys
import tempfile
import time
from pathlib import Path

from jbrep.opengl import prepare_opengl

HELPERS = Path(__file__).resolve().parent.parent / "tests" / "helpers"


def main() -> None:
    sys.path.insert(0, str(HELPERS))
    prepare_opengl()  # before MuJoCo is imported
    from attacks import attack
    from surfaces import surfaces

    times = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    names = sys.argv[2:]
    faults = 0
    with tempfile.TemporaryDirectory() as temporary:
        for surface in surfaces(Path(temporary) / "shared"):
            if names and surface.name not in names:
                continue
            begun = time.monotonic()
            counts = {"kills": times, "full": times, "twice": times // 4, "flips": 10 * times}
            tally = attack(surface, Path(temporary), **counts, seed=1)
            seconds = time.monotonic() - begun
            print(f"{surface.name}: {seconds:.0f} s", flush=True)
            for what, count in sorted(tally.counts.items()):
                print(f"  {count:6} {what}")
            for fault in tally.faults:
                print(f"  FAULT {fault}", flush=True)
            faults += len(tally.faults)
    print(f"{faults} faults")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
