"""Pictures: a state as a camera of the model sees it, with a caption."""

from collections.abc import Sequence
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from jbrep.errors import InputError, choose
from jbrep.jitterbug.model import plain_model
from jbrep.opengl import no_opengl, prepare_opengl
from jbrep.rollouts.rollout import Rollout

Pixels = NDArray[np.uint8]
_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

_SIZES = (64, 3840)  # of a side [pixels]
# a third less work than the model's own settings, with shadows nearly as fine
_SHADOW_PIXELS = 4096
_SHADOW_CONE = 0.4  # share of the light's cone that casts shadows
_SAMPLES = 4  # per pixel

_BAND = (22, 27, 36, 190)
_NAME = (255, 255, 255)
_FACTS = (205, 214, 226)
_SMALLEST_LETTERS = 12  # [pixels]
_LETTERS_IN_HEIGHT = 22
_LINE = 2  # width of the line between pictures [pixels]
_GAP = 0.6  # around the text, in heights of a letter


class Camera:
    """A camera of the model; close it after use.

    Args:
        name: overhead, tracking or egocentric.
        width, height: of its pictures [pixels], even numbers.

    Raises:
        InputError: no such camera, an invalid size, or no OpenGL.
    """

    def __init__(self, name: str = "tracking", width: int = 640, height: int = 480):
        self.width, self.height = width, height
        low, high = _SIZES
        if not all(low <= side <= high and side % 2 == 0 for side in (width, height)):
            raise InputError(
                f"the size is {width}x{height}: both must be even and from {low} to {high}"
            )
        model = plain_model()
        self._id = choose(name, {model.camera(i).name: i for i in range(model.ncam)}, "camera")
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.shadowsize, model.vis.quality.offsamples = _SHADOW_PIXELS, _SAMPLES
        model.vis.map.shadowscale = _SHADOW_CONE
        self._model, self._data = model, mujoco.MjData(model)
        prepare_opengl()
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
            raise no_opengl(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def picture(self, rollout: Rollout, state: int) -> Pixels:
        """One of the n + 1 states of an episode, (height, width, 3)."""
        self._data.qpos[:] = rollout.qpos[state]
        self._data.mocap_pos[0] = rollout.target_position
        self._data.mocap_quat[0] = rollout.target_quaternion
        mujoco.mj_fwdPosition(self._model, self._data)
        self._renderer.update_scene(self._data, self._id)
        return self._renderer.render()


def join(pictures: Sequence[Image.Image]) -> Image.Image:
    """Pictures of the same size side by side, separated by lines."""
    width, height = pictures[0].size
    joined = Image.new("RGB", (width * len(pictures), height))
    draw = ImageDraw.Draw(joined)
    for i, picture in enumerate(pictures):
        joined.paste(picture, (i * width, 0))
        if i:
            draw.line((i * width - 0.5, 0, i * width - 0.5, height), _BAND[:3], _LINE)
    return joined


def band_height(height: int) -> int:
    """Height of the caption on a picture of that height [pixels]."""
    return round(_letters(height) * (1 + 2 * _GAP))


def add_caption(picture: Image.Image, name: str, facts: str) -> None:
    """Draw a caption: the name on the left, shortened at its front to fit, facts on the right."""
    letters, height = _letters(picture.height), band_height(picture.height)
    font, gap = ImageFont.load_default(letters), _GAP * letters
    draw = ImageDraw.Draw(picture, "RGBA")
    draw.rectangle((0, 0, picture.width, height - 1), _BAND)
    middle = height / 2
    draw.text((picture.width - gap, middle), facts, _FACTS, font, anchor="rm")
    room = picture.width - 4 * gap - font.getlength(facts)
    draw.text((gap, middle), _cut(name, font, room), _NAME, font, anchor="lm")


def _letters(height: int) -> int:
    return max(_SMALLEST_LETTERS, height // _LETTERS_IN_HEIGHT)


def _cut(name: str, font: _Font, room: float) -> str:
    """As much of the end of a name as fits; of a path, whole parts if possible."""
    parts = [start for start, letter in enumerate(name) if letter == "/"]
    ends = (f"…{name[start:]}" for start in (*parts, *range(1, len(name))))
    return next((end for end in (name, *ends) if font.getlength(end) <= room), "")
