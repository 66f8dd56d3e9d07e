"""Looking at episodes, encoders and studies: in the Rerun viewer, or as a video."""

import os
import re
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
) -> None:
    """Record an episode or encoder to see in Rerun.

    SOURCE is a data set, a run, an encoder's file, or a policy such as uniform, which needs a
    --task, as does an encoder by its name. An unfinished run plays its last checkpoint. The robot
    is shown where MuJoCo simulates it; with an encoder, what is decoded is shown beside what was
    observed, and for the Jitterbug the decoded robot beside the true one.

    Args:
        episode: episode number, from 0; 0 if not given.
        encoder: a file, a name that ships, or code, mymodule:MyEncoder; a run's own if not given.
        traverse: vary each unit of the latent, and show what is decoded.
        out: an .rrd file; one in inspect/ if not given.
        view: open it in the Rerun viewer.
    """
    from jbrep.encoders.shipped import check_found
    from jbrep.play.sources import check_source
    from jbrep.records.storage import exists

    if task and encoder is not None:
        check_found(encoder, task)
    if source and not exists(source):
        check_source(source)
    from jbrep.inspection import inspect as record  # imports torch

    path = record(source, episode, task, encoder, traverse, out, say)
    say(f"look at it with rerun {quote(str(path))}")
    if view:
        _run_viewer(path)


def _run_viewer(path: Path) -> None:
    """Run Rerun's viewer until it ends."""
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(path)]
    with stoppable(f"{path} stays"):
        code = subprocess.run(command, env={"RUST_LOG": "warn", **os.environ}).returncode
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
    fps: Annotated[float, Meta(ge=1, le=50)] | None = None,
    speed: Annotated[float, Meta(ge=0.01, le=100)] = 1.0,
    seconds: Annotated[float, Meta(ge=0.001, le=3600)] | None = None,
) -> None:
    """Make a video of episodes, side by side.

    A source is the folder of a data set or of a run, or the name of a policy, such as uniform,
    heuristic, trained or constant:drive=0.5, which needs a --task. Robots of MuJoCo can be filmed.
    The Jitterbug's motor turns up to 23 times a second: at full speed and 25 frames per second it
    seems to creep backwards; --speed 0.25 shows how it turns.

    Args:
        out: a new file, .mp4 or .gif.
        episode: episode number, from 0.
        camera: a camera of the robot's model; for the Jitterbug overhead, tracking or egocentric.
            If not given, one that follows the robot.
        size: size of each picture; default 640x480, in a GIF 320x240.
        fps: frames per second; default 25, in a GIF 12.5.
        speed: playback speed; 0.25 is slow motion.
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
