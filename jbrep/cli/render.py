"""Videos."""

from pathlib import Path

import click

from jbrep.cli.base import COUNT, example, printable, stoppable


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
            self.fail(f"{value!r} is no size: write it as 640x480")
        return int(width), int(height)


@click.command(
    epilog=example("jbrep render heuristic --task move_to_pose --speed 0.25 --out bug.mp4")
)
@click.argument("sources", nargs=-1, required=True)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="A new file, .mp4 or .gif."
)
@click.option("--task", help="Of policies by name, such as move_to_pose.")
@click.option("--episode", default=0, show_default=True, type=COUNT, help="Its number, from 0.")
@click.option(
    "--camera", default="tracking", show_default=True, help="overhead, tracking or egocentric."
)
@click.option(
    "--size", type=_Size(), help="Of each picture; if not given 640x480, in a GIF 320x240."
)
@click.option("--fps", type=float, help="Frames a second; 25 if not given, in a GIF 12.5.")
@click.option("--speed", default=1.0, show_default=True, help="0.25 is slow motion.")
@click.option(
    "--seconds", default=10.0, show_default=True, help="Simulated ones to show, from the start."
)
def render(
    sources: tuple[str, ...],
    out: Path,
    task: str | None,
    episode: int,
    camera: str,
    size: tuple[int, int] | None,
    fps: float | None,
    speed: float,
    seconds: float,
) -> None:
    """Make a video of episodes, side by side.

    A source is the folder of a data set or of a run that is over, or a policy by its name, such as
    uniform, heuristic or constant:drive=0.5. The motor turns up to 23 times a second: at full
    speed and 25 frames a second it seems to creep backwards; --speed 0.25 shows how it turns.
    """
    from jbrep.opengl import find_opengl

    find_opengl()
    from jbrep.render.film import Film, Pace
    from jbrep.render.formats import get_format
    from jbrep.render.pictures import Camera
    from jbrep.rollouts.sources import find_episode

    form = get_format(out)
    pace = Pace(form.fps if fps is None else fps, speed, seconds)
    with stoppable("no video was written"), Camera(camera, *(size or form.size)) as seen_by:
        rollouts = [find_episode(source, episode, task) for source in sources]
        film = Film(rollouts, seen_by, pace)
        film.write(out, show=True)
    click.echo(
        printable(
            f"{out}: {film.width} x {seen_by.height} pixels, {film.seconds:.1f} s, "
            f"{len(film)} frames, {out.stat().st_size / 1e6:.1f} MB"
        )
    )
