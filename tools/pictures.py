"""Draw the pictures in the README and in docs/: python tools/pictures.py docs."""

import sys
from pathlib import Path

from PIL import Image

from jbrep import jitterbug

CAMERAS = ("overhead", "tracking", "egocentric")
SIZE = (480, 640)  # height, width [pixels]
SETTLE_STEPS = 40


def main(folder: Path) -> None:
    environment = jitterbug.load("move_to_pose", seed=141)
    environment.reset()
    for _ in range(SETTLE_STEPS):
        environment.step([0.0])
    for camera in CAMERAS:
        frame = environment.physics.render(*SIZE, camera_id=camera)
        Image.fromarray(frame).save(folder / f"{camera}.png", optimize=True)
        print(folder / f"{camera}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
