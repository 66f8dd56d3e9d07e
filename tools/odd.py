"""Play an environment of each oddity by every command, at each moment; print what goes wrong."""

import sys
import tempfile
from pathlib import Path

sys.path[:0] = [
    str(Path(__file__).parents[1] / "tests"),
    str(Path(__file__).parents[1] / "tests/helpers"),
]

from odd import FAILS, HARMLESS  # noqa: E402
from test_odd_environments import COMMANDS, WHEN, problem  # noqa: E402


def main() -> None:
    """Try all, or those whose names are given."""
    tried = wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for how in sys.argv[1:] or (*HARMLESS, *FAILS):
            for command in COMMANDS:
                for when in WHEN:
                    tried += 1
                    if told := problem(command, how, when, Path(folder, str(tried))):
                        wrong += 1
                        print(f"{how}, {command}, {when}: {told}", flush=True)
    print(f"{tried} tried, {wrong} wrong")


if __name__ == "__main__":
    main()
