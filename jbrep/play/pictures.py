"""Pictures: a state as a camera of the model sees it, with a caption."""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple, Self

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from jbrep.envs.physics import Motion, root_of
from jbrep.errors import InputError, choose
from jbrep.opengl import no_opengl, prepare_opengl

Pixels = NDArray[np.uint8]
_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

_SIZES = (64, 3840)  # of a side [pixels]
# a third less work than the model's own settings, with shadows nearly as fine
_SHADOW_PIXELS = 4096
_SHADOW_CONE = 0.4  # share of the light's cone that casts shadows
_SAMPLES = 4  # per pixel

_FOLLOWING = (mujoco.mjtCamLight.mjCAMLIGHT_TRACK, mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)

_BAND = (22, 27, 36, 190)
_NAME = (255, 255, 255)
_FACTS = (205, 214, 226)
_SMALLEST_LETTERS = 12  # [pixels]
_LETTERS_IN_HEIGHT = 22
_LINE = 2  # width of the line between pictures [pixels]
_GAP = 0.6  # around the text, in heights of a letter


class _Studio(NamedTuple):
    motion_model: mujoco.MjModel  # whose pictures they are; the renderer has a copy
    model: mujoco.MjModel
    data: mujoco.MjData
    renderer: mujoco.Renderer
    camera: mujoco.MjvCamera | int


class Camera:
    """A camera of a robot's model; close it after use.

    Args:
        name: of one that the model has; if None, its first that follows a body, or else one that
            follows the robot from aside.
        width, height: of its pictures [pixels], even numbers.
    """

    def __init__(self, name: str | None = None, width: int = 640, height: int = 480):
        self.name, self.width, self.height = name, width, height
        low, high = _SIZES
        if not all(low <= side <= high and side % 2 == 0 for side in (width, height)):
            raise InputError(
                f"the size is {width}x{height}: both must be even and from {low} to {high}"
            )
        self._studios: list[_Studio] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderers."""
        for studio in self._studios:
            studio.renderer.close()
        self._studios = []

    def picture(self, motion: Motion, state: int) -> Pixels:
        """One of the states of an episode, (height, width, 3)."""
        studio = self._studio(motion.model)
        motion.put(studio.data, state)
        mujoco.mj_fwdPosition(studio.model, studio.data)
        studio.renderer.update_scene(studio.data, studio.camera)
        return studio.renderer.render()

    def _studio(self, model: mujoco.MjModel) -> _Studio:
        """The studio for a model, made with its first picture."""
        for studio in self._studios:
            if studio.motion_model is model:
                return studio
        camera, own = find_camera(model, self.name), copy(model)
        own.vis.global_.offwidth, own.vis.global_.offheight = self.width, self.height
        own.vis.quality.shadowsize, own.vis.quality.offsamples = _SHADOW_PIXELS, _SAMPLES
        own.vis.map.shadowscale = _SHADOW_CONE
        prepare_opengl()
        try:
            renderer = mujoco.Renderer(own, self.height, self.width)
        except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
            raise no_opengl(error) from error
        self._studios.append(_Studio(model, own, mujoco.MjData(own), renderer, camera))
        return self._studios[-1]


def find_camera(model: mujoco.MjModel, name: str | None) -> mujoco.MjvCamera | int:
    """A camera of the model by its name, or the one that suits it, see `Camera`."""
    if name is not None:
        return choose(name, {model.camera(i).name: i for i in range(model.ncam)}, "camera")
    for number in range(model.ncam):
        if int(model.cam_mode[number]) in _FOLLOWING:
            return number
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if root := root_of(model):
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, root
    return camera


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
