"""Play environments of each oddity by every command, at each moment: python tools/odd.py.

Words after it are the oddities to try. It prints what goes wrong, and ends with code 1 where
anything does.
"""

import sys
import tempfile
from importlib import import_module
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent / "tests"


def main() -> None:
    sys.path[:0] = [str(TESTS), str(TESTS / "helpers")]
    odd, tests = import_module("odd"), import_module("test_odd_environments")
    tried = wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for how in sys.argv[1:] or (*odd.HARMLESS, *odd.FAILS):
            for command in tests.COMMANDS:
                for when in tests.WHEN:
                    if (how, when) == (tests.STALL, "make"):
                        continue  # making it may take its time
                    tried += 1
                    if told := tests.problem(command, how, when, Path(folder, str(tried))):
                        wrong += 1
                        print(f"{how}, {command}, {when}: {told}", flush=True)
    print(f"{tried} tried, {wrong} wrong")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
