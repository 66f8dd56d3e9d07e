"""Check well-made robots and print the table of docs/check.md: python tools/check.py."""

import argparse
import sys
from pathlib import Path

import jbrep

ROOT = Path(__file__).parent.parent
ROBOTS = (
    *("move_from_origin", "face_direction", "move_in_direction", "move_to_position"),
    *("move_to_pose", "Pendulum-v1", "Hopper-v5", "Ant-v5", "InvertedPendulum-v5"),
    *("RawPendulum-v0", "RawCartPole-v0"),
)


def main() -> None:
    """Check each robot that is named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=ROBOTS)
    parser.add_argument("--steps", type=int, default=44_000)
    given = parser.parse_args()
    sys.path.insert(0, str(ROOT / "examples/robots"))
    import mybots  # type: ignore[import-not-found]  # noqa: F401  # it registers the last two

    print("| task | found | begin with |\n|---|---|---|", flush=True)
    for robot in given.robots:
        check = jbrep.check(robot, steps=given.steps)
        found = "; ".join(each.title for each in check.findings) or "nothing"
        print(f"| `{robot}` | {found} | `{check.advice.representation}` |", flush=True)


if __name__ == "__main__":
    main()
