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
from jbrep.records.storage import exists

_X264 = {"crf": "18", "preset": "medium"}  # no loss that the eye can see
_TICK = 0.01  # GIF's unit of time [s]
_SAMPLES = 8  # frames that the palette is computed from
_COLOURS = 128  # files are a fifth smaller than with 256, and look the same
_IN_MEMORY = 2e8  # [pixels], of three bytes


class Format(NamedTuple):
    """A file format, with the settings that suit it."""

    encode: Callable[[Iterable[Image.Image], Path, float], None]  # frames of one size; fps
    fps: float
    size: tuple[int, int]  # of a picture, width and height [pixels]
    most_pixels: float = math.inf  # in all frames


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


FORMATS = {
    ".mp4": Format(encode_mp4, 25, (640, 480)),
    ".gif": Format(encode_gif, 12.5, (320, 240), _IN_MEMORY),
}


def get_format(path: Path) -> Format:
    """The format of a new video, by its suffix.

    Raises:
        InputError: an unknown suffix, or the file exists.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"{path} isn't named as a video: the suffix must be {' or '.join(FORMATS)}"
        )
    if exists(path):
        raise InputError(f"{path} exists already: choose another name")
    return FORMATS[path.suffix.lower()]
