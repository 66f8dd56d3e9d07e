"""Videos."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, PATH
from jbrep.cli.environment import environment_options, given_task, task_option
from jbrep.cli.output import say
from jbrep.cli.signals import stoppable


class _Size(click.ParamType[tuple[int, int]]):
    """Width and height in pixels: 640x480."""

    name = "size"

    def convert(
        self,
        value: str | tuple[int, int],
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> tuple[int, int]:
        width, _, height = str(value).partition("x")
        if not (width.isdecimal() and height.isdecimal()):
            self.fail(f"{value!r} isn't a size: write it as 640x480")
        return int(width), int(height)


@click.command(
    epilog="Example: jbrep render heuristic --task move_to_pose --speed 0.25 --out bug.mp4"
)
@click.argument("sources", nargs=-1, required=True)
@click.option("--out", required=True, type=PATH, help="A new file, .mp4 or .gif.")
@task_option
@click.option("--episode", default=0, show_default=True, type=COUNT, help="Its number, from 0.")
@click.option(
    "--camera",
    help="One that the robot's model has: of the Jitterbug overhead, tracking or egocentric. If "
    "not given, one that follows the robot.",
)
@click.option("--size", type=_Size(), help="Of each picture; default 640x480, in a GIF 320x240.")
@click.option("--fps", type=float, help="Frames per second; default 25, in a GIF 12.5.")
@click.option("--speed", default=1.0, show_default=True, help="0.25 is slow motion.")
@click.option(
    "--seconds", type=float, help="Simulated seconds to show, from the start; all if not given."
)
@environment_options
def render(
    sources: tuple[str, ...],
    out: Path,
    episode: int,
    camera: str | None,
    size: tuple[int, int] | None,
    fps: float | None,
    speed: float,
    seconds: float | None,
    **options: Any,
) -> None:
    """Make a video of episodes, side by side.

    A source is the folder of a data set or of a run, or the name of a policy, such as uniform,
    heuristic, trained or constant:drive=0.5, which needs a --task. Robots of MuJoCo are seen by a
    camera; another environment draws itself, by its own render() with render_mode="rgb_array".
    The Jitterbug's motor turns up to 23 times a second: at full speed and 25 frames per second it
    seems to creep backwards; --speed 0.25 shows how it turns.
    """
    from jbrep.opengl import find_opengl

    find_opengl()
    from jbrep.play.sources import check_source, find_episode

    task = given_task(options)
    for source in sources:
        check_source(source)
    from jbrep.play.film import Film, Pace, get_format
    from jbrep.play.pictures import Camera

    form = get_format(out)
    pace = Pace(form.fps if fps is None else fps, speed, seconds)
    with stoppable("no video was written"), Camera(camera, *(size or form.size)) as seen_by:
        rollouts = [find_episode(source, episode, task) for source in sources]
        film = Film(rollouts, seen_by, pace)
        film.write(out, show=True)
    say(
        f"{out}: {film.width} x {seen_by.height} pixels, {film.seconds:.1f} s, "
        f"{len(film)} frames, {out.stat().st_size / 1e6:.1f} MB"
    )
