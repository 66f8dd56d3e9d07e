"""Check well-made robots and write the table of docs/checking.md: python tools/check.py [--steps N]."""

import argparse
import sys
from pathlib import Path

import gymnasium

import jbrep
from jbrep.text import counted

sys.path.insert(0, str(Path(__file__).parent.parent / "examples/check"))

ROBOTS = (
    *("move_from_origin", "face_direction", "move_in_direction", "move_to_position"),
    *("move_to_pose", "Pendulum-v1", "Hopper-v5", "Ant-v5", "CartPole-v9", "RawPendulum-v0"),
)


def main() -> None:
    """Check each robot that is named, or all."""
    parser = argparse.ArgumentParser()
    parser.add_argument("robots", nargs="*", default=ROBOTS)
    parser.add_argument("--steps", type=int, default=44_000)
    given = parser.parse_args()
    import raw  # registers the last two
    print("| task | found | begin with |\n|---|---|---|", flush=True)
    for robot in given.robots:
        check = jbrep.check(robot, steps=given.steps)
        found = "; ".join(each.title for each in check.findings) or "nothing"
        print(f"| `{robot}` | {found} | `{check.advice.representation}` |", flush=True)


if __name__ == "__main__":
    main()
