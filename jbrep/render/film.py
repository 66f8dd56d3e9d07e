"""Episodes as a sequence of pictures in time, and its files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from jbrep.errors import InputError
from jbrep.files.storage import make_folder, write_whole
from jbrep.jitterbug.tasks import CONTROL_TIMESTEP, EPISODE_STEPS
from jbrep.progress import Progress
from jbrep.render.formats import get_format
from jbrep.render.pictures import Camera, add_caption, join
from jbrep.rollouts.rollout import Rollout

_LONGEST = EPISODE_STEPS * CONTROL_TIMESTEP  # [s]
_SPEEDS = (0.01, 100)
_WIDEST = 7680  # [pixels]


@dataclass(frozen=True)
class Pace:
    """How time goes by in a film.

    Args:
        fps: frames a second of the film.
        speed: of the film over that of the simulation.
        seconds: simulated ones to show, from the start.

    Raises:
        InputError: one out of range.
    """

    fps: float = 25
    speed: float = 1
    seconds: float = _LONGEST

    def __post_init__(self) -> None:
        for what, value, (low, high) in (
            ("frames a second", self.fps, (1, 50)),
            ("speed", self.speed, _SPEEDS),
            ("simulated seconds", self.seconds, (CONTROL_TIMESTEP, _LONGEST)),
        ):
            if not low <= value <= high:
                raise InputError(f"{what}: {value:g}, it must be from {low:g} to {high:g}")


@dataclass(frozen=True, eq=False)
class Film:
    """Episodes side by side; one that ends before the others stands still from there on.

    Args:
        rollouts: the episodes, of one task and with one start.
        camera: that sees each.
        pace: how time goes by.

    Raises:
        InputError: episodes that differ in that, or too many for the width.
    """

    rollouts: Sequence[Rollout]
    camera: Camera
    pace: Pace

    def __post_init__(self) -> None:
        if self.width > _WIDEST:
            raise InputError(
                f"{len(self.rollouts)} pictures are {self.width:,} pixels wide: at most "
                f"{_WIDEST:,} go side by side; choose a smaller --size"
            )
        first = self.rollouts[0]
        for other in self.rollouts[1:]:
            if not _start_alike(first, other):
                raise InputError(
                    f"{first.name} and {other.name} differ in their task or start: side by side "
                    "go episodes that share both, as those of runs and policies of one task do"
                )

    @property
    def width(self) -> int:
        """Of a frame [pixels]."""
        return len(self.rollouts) * self.camera.width

    @property
    def seconds(self) -> float:
        """That it lasts."""
        return len(self) / self.pace.fps

    def __len__(self) -> int:
        longest = CONTROL_TIMESTEP * max(map(len, self.rollouts))
        shown = min(self.pace.seconds, longest)
        return max(1, round(shown / self.pace.speed * self.pace.fps))

    @property
    def states(self) -> NDArray[np.int_]:
        """The state nearest in time to each frame, (frames,), as if no episode ended."""
        times = np.arange(len(self)) * self.pace.speed / self.pace.fps
        return np.rint(times / CONTROL_TIMESTEP).astype(int)

    def frames(self) -> Iterator[Image.Image]:
        """The frames, one after the other."""
        for state in self.states:
            yield join([self._picture(rollout, state) for rollout in self.rollouts])

    def _picture(self, rollout: Rollout, state: int) -> Image.Image:
        state = min(state, len(rollout))
        so_far, now = rollout.reward[:state].sum(), rollout.time[state]
        picture = Image.fromarray(self.camera.picture(rollout, state))
        add_caption(picture, rollout.name, f"return {so_far:.0f}    {now:.2f} s")
        return picture

    def write(self, path: Path, show: bool = False) -> None:
        """Encode it into a new file, whole or not at all.

        Args:
            path: the file, .mp4 or .gif.
            show: a bar, too.

        Raises:
            InputError: another suffix, a file that is there or can't be written, or too much of
                it for a GIF.
        """
        form = get_format(path)
        pixels = len(self) * self.width * self.camera.height
        if pixels > form.most_pixels:
            raise InputError(
                f"{path} would have {pixels:,} pixels, at most {form.most_pixels:,.0f} go into "
                f"a {path.suffix}: choose a smaller --size or --fps, fewer --seconds, or .mp4"
            )
        make_folder(path.parent)
        with (
            TemporaryDirectory() as folder,
            Progress(
                self.frames(), total=len(self), unit="frame", delay=0.5, disable=not show
            ) as bar,
        ):
            encoded = Path(folder) / path.name
            form.encode(bar, encoded, self.pace.fps)
            write_whole(path, encoded.read_bytes())


def _start_alike(one: Rollout, other: Rollout) -> bool:
    return one.task == other.task and all(
        np.array_equal(a, b)
        for a, b in (
            (one.qpos[0], other.qpos[0]),
            (one.target_position, other.target_position),
            (one.target_quaternion, other.target_quaternion),
        )
    )
