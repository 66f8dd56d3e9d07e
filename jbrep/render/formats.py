"""Video files: H.264 in MP4, and GIF."""

import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from jbrep.errors import InputError
from jbrep.files.storage import exists

_X264 = {"crf": "18", "preset": "medium"}  # to the eye as good as the frames
_TICK = 0.01  # in which GIF counts [s]
_SAMPLES = 8  # frames that a palette is made of
_COLOURS = 128  # a fifth smaller than with twice as many, and looks the same
_IN_MEMORY = 2e8  # [pixels], of three bytes


class Format(NamedTuple):
    """A kind of file, and what suits it."""

    encode: Callable[[Iterable[Image.Image], Path, float], None]  # frames of one size; fps
    fps: float
    size: tuple[int, int]  # of a picture, width and height [pixels]
    most_pixels: float = math.inf  # in all frames


def encode_mp4(frames: Iterable[Image.Image], path: Path, fps: float) -> None:
    """H.264 as browsers play it, from the first byte on."""
    import av
    from av.video.reformatter import ColorRange, Colorspace

    frames = iter(frames)
    first = next(frames)
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate, options=_X264)
        stream.width, stream.height = first.size
        stream.pix_fmt = "yuv420p"
        # what the frames are turned into; players guess another where it isn't said
        stream.codec_context.colorspace = Colorspace.ITU601
        stream.codec_context.color_range = ColorRange.MPEG
        for frame in chain((first,), frames):
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))
        container.mux(stream.encode())


def encode_gif(frames: Iterable[Image.Image], path: Path, fps: float) -> None:
    """A loop without end, in one palette and undithered: what stands still costs nothing."""
    pictures = list(frames)
    samples = [np.asarray(p) for p in pictures[:: -(-len(pictures) // _SAMPLES)]]
    # by coverage: the robot is small, and counting pixels would leave its colours out
    together = Image.fromarray(np.concatenate(samples))
    palette = together.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=2)
    first, *others = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    ends = np.rint(np.arange(len(pictures) + 1) / fps / _TICK).astype(int)
    milliseconds = (np.diff(ends) * round(1000 * _TICK)).tolist()
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


FORMATS = {
    ".mp4": Format(encode_mp4, 25, (640, 480)),
    ".gif": Format(encode_gif, 12.5, (320, 240), _IN_MEMORY),
}


def get_format(path: Path) -> Format:
    """That of a new video, by its suffix.

    Raises:
        InputError: another suffix, or a file that is there.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path} has no suffix of a video: {' or '.join(FORMATS)} is needed")
    if exists(path):
        raise InputError(f"{path} is there already: choose another name")
    return FORMATS[path.suffix.lower()]
