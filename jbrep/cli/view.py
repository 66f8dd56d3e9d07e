"""Looking at episodes, encoders and studies: in the Rerun viewer, or as a video."""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path
from shlex import quote
from typing import Annotated

from msgspec import Meta

from jbrep.cli.base import command, say
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError
from jbrep.parameters import OptionalTask
from jbrep.text import facts, printable, terminal_width

_ADDRESS = "127.0.0.1"
# Waits for the end of its input, which comes when jbrep ends, even killed; then ends its own group.
_KEEPER = ("sh", "-c", "read -r _; kill 0")
_Number = Annotated[int, Meta(ge=0, le=10**9)]


@command("inspect data/face --episode 3 --encoder dae-8 --view")
def inspect(
    source: str | None = None,
    /,
    *,
    episode: _Number | None = None,
    task: OptionalTask = None,
    encoder: Annotated[str | None, Meta(extra={"is_code": True})] = None,
    traverse: bool = False,
    out: Path | None = None,
    view: bool = False,
    serve: bool = False,
) -> None:
    """Record an episode or encoder to see in Rerun.

    SOURCE is a data set, a run, an encoder's file, or a policy such as uniform, which needs a
    --task, as does an encoder by its name. An unfinished run plays its last checkpoint. The robot
    is shown where MuJoCo simulates it; with an encoder, what is decoded is shown beside what was
    observed, and for the Jitterbug the decoded robot beside the true one.

    Args:
        episode: its number, from 0; 0 if not given.
        encoder: a file, a name that ships, or code, mymodule:MyEncoder; a run's own if not given.
        traverse: show what each unit of the latent moves.
        out: an .rrd file; one in inspect/ if not given.
        view: open it in the Rerun viewer.
        serve: show it to a browser on this machine until Ctrl-C. Meanwhile every user and program
            of the machine can read the recording, too; Rerun asks for no password and checks no
            host name.
    """
    if view and serve:
        raise InputError("--view and --serve exclude each other: choose one")
    from jbrep.encoders.shipped import check_found
    from jbrep.play.sources import check_source
    from jbrep.records.storage import exists

    if task and encoder is not None:
        check_found(encoder, task)
    if source and not exists(source):
        check_source(source)
    from jbrep.inspection import inspect as record  # imports torch

    path = record(source, episode, task, encoder, traverse, out, say)
    if view or serve:
        say(str(path))
    else:
        say("open it with:")
        say(f"rerun {quote(str(path))}")
    if view:
        _run_viewer(path)
    if serve:
        page, recording = _free_ports()
        say(f"http://{_ADDRESS}:{page}/?url=rerun%2Bhttp://{_ADDRESS}:{recording}/proxy")
        say("Ctrl-C stops it")
        ports = ("--web-viewer-port", str(page), "--port", str(recording))
        _run_viewer(path, "--serve-web", *ports)


def _free_ports() -> tuple[int, int]:
    """Unused ports: on one in use, Rerun would connect to the program that listens there."""
    anything = (_ADDRESS, 0)
    with socket.create_server(anything) as one, socket.create_server(anything) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _run_viewer(path: Path, *options: str) -> None:
    """Run Rerun's viewer until it ends, or this process does in whatever way."""
    command = [sys.executable, "-m", "rerun", "--bind", _ADDRESS, *options, str(path)]
    quiet = {"RUST_LOG": "warn", **os.environ}
    with (
        stoppable(f"{path} stays"),
        subprocess.Popen(_KEEPER, stdin=subprocess.PIPE, process_group=0) as keeper,
        # in the keeper's group, as is the program that this script starts
        subprocess.Popen(command, process_group=keeper.pid, env=quiet) as viewer,
    ):
        try:
            code = viewer.wait()
        finally:
            assert keeper.stdin is not None
            keeper.stdin.close()
    if code:
        raise InputError(f"the Rerun viewer ended with code {code}; {path} stays")


@command("render heuristic --task move_to_pose --speed 0.25 --out bug.mp4")
def render(
    *sources: str,
    out: Path,
    task: OptionalTask = None,
    episode: _Number = 0,
    camera: str | None = None,
    size: Annotated[str, Meta(extra={"metavar": "WIDTHxHEIGHT"})] = "",
    fps: float | None = None,
    speed: float = 1.0,
    seconds: float | None = None,
) -> None:
    """Make a video of episodes, side by side.

    A source is the folder of a data set or of a run, or the name of a policy, such as uniform,
    heuristic, trained or constant:drive=0.5, which needs a --task. Robots of MuJoCo are seen by a
    camera; another environment draws itself, by its own render() with render_mode="rgb_array".
    The Jitterbug's motor turns up to 23 times a second: at full speed and 25 frames per second it
    seems to creep backwards; --speed 0.25 shows how it turns.

    Args:
        out: a new file, .mp4 or .gif.
        episode: its number, from 0.
        camera: one that the robot's model has: of the Jitterbug overhead, tracking or egocentric.
            If not given, one that follows the robot.
        size: of each picture; default 640x480, in a GIF 320x240.
        fps: frames per second; default 25, in a GIF 12.5.
        speed: 0.25 is slow motion.
        seconds: simulated seconds to show, from the start; all if not given.
    """
    from jbrep.opengl import find_opengl

    find_opengl()
    from jbrep.play.sources import check_source, find_episode

    for source in sources:
        check_source(source)
    from jbrep.play.film import Film, Pace, get_format
    from jbrep.play.pictures import Camera

    form = get_format(out)
    pixels = _size(size) if size else form.size
    pace = Pace(form.fps if fps is None else fps, speed, seconds)
    with stoppable("no video was written"), Camera(camera, *pixels) as seen_by:
        rollouts = [find_episode(source, episode, task) for source in sources]
        film = Film(rollouts, seen_by, pace)
        film.write(out, show=True)
    say(
        f"{out}: {film.width} x {seen_by.height} pixels, {film.seconds:.1f} s, "
        f"{len(film)} frames, {out.stat().st_size / 1e6:.1f} MB"
    )


def _size(text: str) -> tuple[int, int]:
    """Width and height in pixels."""
    if not (found := re.fullmatch(r"(?a)(\d+)x(\d+)", text)):
        raise InputError(f"--size is {text!r}: it must be WIDTHxHEIGHT, such as 640x480")
    return int(found[1]), int(found[2])


@command("doctor")
def doctor() -> bool:
    """Show what this machine has, and what is missing.

    Cores, memory, disk, GPU, OpenGL, and the packages of each extra with their versions. The exit
    code is 1 if a core package is missing or a package has an unsuitable version.
    """
    from jbrep.doctor import examine

    findings = list(examine())
    said = {finding.what: printable(finding.said) for finding in findings}
    say(facts(said, terminal_width(), indent=0))
    return any(finding.is_wrong for finding in findings)
