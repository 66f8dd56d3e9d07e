"""Films: MuJoCo's states as a sequence of frames, in files of H.264 (MP4) or GIF."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from jbrep.errors import InputError
from jbrep.play.pictures import Camera, add_caption, join
from jbrep.play.rollout import Rollout
from jbrep.progress import Progress
from jbrep.records.storage import exists, make_folder, taken, write_new
from jbrep.text import rounded

_WIDEST = 7680  # [pixels]
_X264 = {"crf": "18", "preset": "medium"}  # no loss that the eye can see
_TICK = 0.01  # GIF's unit of time [s]
_SAMPLES = 8  # frames that the palette is computed from
_COLOURS = 128  # files are a fifth smaller than with 256, and look the same


class Pace(NamedTuple):
    """How fast a film shows simulated time."""

    fps: float = 25  # frames per second of the film
    speed: float = 1  # simulated seconds per second of the film
    seconds: float | None = None  # simulated ones to show, from the start; None for all


@dataclass(frozen=True, eq=False)
class Film:
    """Episodes side by side; one that ends before the others stands still afterwards."""

    rollouts: Sequence[Rollout]  # of the same task and from the same start
    camera: Camera
    pace: Pace

    def __post_init__(self) -> None:
        if self.width > _WIDEST:
            raise InputError(
                f"{len(self.rollouts)} pictures side by side are {self.width:,} pixels wide: at "
                f"most {_WIDEST:,} are possible; choose a smaller `size`"
            )
        starts = [_start(rollout) for rollout in self.rollouts]
        for rollout, start in zip(self.rollouts, starts, strict=True):
            if start != starts[0]:
                raise InputError(
                    f"{self.rollouts[0].name} and {rollout.name} differ in their task or start: "
                    "only episodes that share both can be shown side by side, as those of policies "
                    "of one task"
                )

    @property
    def width(self) -> int:
        """Width of a frame [pixels]."""
        return len(self.rollouts) * self.camera.width

    @property
    def seconds(self) -> float:
        """Length of the film [s]."""
        return len(self) / self.pace.fps

    def __len__(self) -> int:
        longest = self.timestep * max(map(len, self.rollouts))
        shown = longest if self.pace.seconds is None else min(self.pace.seconds, longest)
        return max(1, round(shown / self.pace.speed * self.pace.fps))

    @property
    def timestep(self) -> float:
        """From one state to the next [s]."""
        return self.rollouts[0].task.known_timestep

    @property
    def states(self) -> NDArray[np.int_]:
        """The state nearest in time to each frame, (frames,), as if no episode ended."""
        times = np.arange(len(self)) * self.pace.speed / self.pace.fps
        return np.rint(times / self.timestep).astype(int)

    def frames(self) -> Iterator[Image.Image]:
        """The frames in order."""
        every = [self._pictures(rollout) for rollout in self.rollouts]
        for pictures in zip(*every, strict=True):
            yield join(pictures)

    def _pictures(self, rollout: Rollout) -> Iterator[Image.Image]:
        assert rollout.motion
        for state in np.minimum(self.states, len(rollout)).tolist():
            picture = Image.fromarray(self.camera.picture(rollout.motion, state))
            so_far, now = rollout.reward[:state].sum(dtype=np.float64), self.timestep * state
            known = f"return {rounded(so_far)[0]}    " if np.isfinite(so_far) else ""
            add_caption(picture, rollout.name, f"{known}{now:.2f} s")
            yield picture

    def write(self, path: Path, show: bool = False) -> None:
        """Encode it into a new file, whole or not at all."""
        form = get_format(path)
        make_folder(path.parent)
        with (
            TemporaryDirectory() as folder,
            Progress(
                self.frames(), total=len(self), unit="frame", delay=0.5, disable=not show
            ) as bar,
        ):
            encoded = Path(folder) / path.name
            form.encode(bar, encoded, self.pace.fps)
            write_new(path, encoded.read_bytes())


def _start(rollout: Rollout) -> tuple[Any, ...]:
    """What episodes that can be shown side by side share."""
    if rollout.note:
        raise InputError(f"{rollout.note}; it can't be filmed, but jbrep inspect shows its signals")
    if rollout.motion is None:
        raise InputError(
            f"{rollout.task.name} has no MuJoCo model and data: it can't be filmed, but jbrep "
            "inspect shows its signals"
        )
    task, arrays = rollout.task, rollout.motion.arrays
    return (
        task,
        task.known_timestep,
        *(arrays[n][0].tolist() for n in ("qpos", "mocap_pos", "mocap_quat")),
    )


class Format(NamedTuple):
    """A file format, with the settings that suit it."""

    encode: Callable[[Iterable[Image.Image], Path, float], None]  # frames of one size; fps
    fps: float
    size: tuple[int, int]  # of a picture, width and height [pixels]


def encode_mp4(frames: Iterable[Image.Image], path: Path, fps: float) -> None:
    """H.264 as browsers play it, streamable."""
    import av
    from av.video.reformatter import ColorRange, Colorspace

    frames = iter(frames)
    first = next(frames)
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate, options=_X264)
        stream.width, stream.height = first.size
        stream.pix_fmt = "yuv420p"
        # without these two, players guess the colour space, and guess wrong
        stream.codec_context.colorspace = Colorspace.ITU601
        stream.codec_context.color_range = ColorRange.MPEG
        for frame in chain((first,), frames):
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())


def encode_gif(frames: Iterable[Image.Image], path: Path, fps: float) -> None:
    """An endless loop with one palette and no dithering, so that still areas compress well."""
    pictures = list(frames)
    samples = [np.asarray(p) for p in pictures[:: -(-len(pictures) // _SAMPLES)]]
    # by coverage of the colour space: by counts, the small robot would lose its colours
    together = Image.fromarray(np.concatenate(samples))
    palette = together.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=2)
    first, *others = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    ends = np.rint(np.arange(len(pictures) + 1) / fps / _TICK).astype(int)
    milliseconds = (np.diff(ends) * round(1000 * _TICK)).tolist()
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


FORMATS = {".mp4": Format(encode_mp4, 25, (640, 480)), ".gif": Format(encode_gif, 12.5, (320, 240))}


def get_format(path: Path) -> Format:
    """The format of a new video, by its suffix."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"{path} isn't named as a video: the suffix must be {' or '.join(FORMATS)}"
        )
    if exists(path):
        raise taken(path)
    return FORMATS[path.suffix.lower()]
