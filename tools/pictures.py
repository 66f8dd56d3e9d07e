"""Draw the pictures in docs/: python tools/pictures.py REPORT RECORDING FOLDER.

The robot needs OpenGL, the report Chromium, and the recording a Vulkan driver for Rerun's viewer
without a window.
"""

import io
import shutil
import subprocess
import sys
import time
from pathlib import Path

import rerun_cli
from PIL import Image
from playwright.sync_api import sync_playwright
from rerun.experimental import ViewerClient

from jbrep import jitterbug

CAMERAS = ("overhead", "tracking", "egocentric")
FRAME = (480, 640)  # of a camera: height, width [pixels]
SETTLE_STEPS = 40
SIZE = (1180, 1750)  # of the report [pixels]
WINDOW = "1760x1080"
BAR = 36  # height of the viewer's title bar [pixels]
SECONDS = 5.8  # into the episode
PORT = 9977
START, DRAW = 10, 4  # [s]


def robot(folder: Path) -> None:
    """The robot by each camera."""
    environment = jitterbug.load("move_to_pose", seed=141)
    environment.reset()
    for _ in range(SETTLE_STEPS):
        environment.step([0.0])
    for camera in CAMERAS:
        frame = environment.physics.render(*FRAME, camera_id=camera)
        Image.fromarray(frame).save(folder / f"{camera}.png", optimize=True)
        print(folder / f"{camera}.png")


def report(page: Path, out: Path) -> None:
    with sync_playwright() as started:
        path = shutil.which("chromium") or shutil.which("google-chrome")
        browser = started.chromium.launch(executable_path=path, args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        opened.goto(page.resolve().as_uri())
        save(Image.open(io.BytesIO(opened.screenshot())), out)
        browser.close()


def recording(path: Path, out: Path) -> None:
    program = Path(rerun_cli.__file__).with_name("rerun")
    options = ("--headless", "--window-size", WINDOW, "--port", str(PORT))
    viewer = subprocess.Popen([program, *options, path])
    try:
        time.sleep(START)
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{PORT}/proxy")
        client.set_time("time", duration=SECONDS, play_state="paused")
        time.sleep(DRAW)
        client.save_screenshot(str(out))
    finally:
        viewer.terminate()
        viewer.wait()
    shown = Image.open(io.BytesIO(out.read_bytes()))
    save(shown.crop((0, BAR, *shown.size)), out)


def save(picture: Image.Image, out: Path) -> None:
    """With 256 colours, chosen by coverage so that small details keep theirs."""
    shown = picture.convert("RGB")
    few = shown.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE)
    few.save(out, optimize=True)
    print(out)


if __name__ == "__main__":
    page, episode, folder = map(Path, sys.argv[1:])
    robot(folder)
    report(page, folder / "report.png")
    recording(episode, folder / "rerun.png")
