"""What a film shows of an episode: pictures of MuJoCo's states, or what its environment draws."""

from collections.abc import Iterable, Iterator
from typing import Any, Protocol

import numpy as np
from PIL import Image, ImageOps

from jbrep.envs.lanes import Lanes
from jbrep.errors import InputError, kind_and_line
from jbrep.play.pictures import Camera
from jbrep.play.rollout import Rollout

_OWN = {"render_mode": "rgb_array"}


class Scene(Protocol):
    """An episode that pictures can be taken of.

    Attributes:
        timestep: from one state to the next [s].
        start: equals that of another of the same task and from the same start.
    """

    timestep: float
    start: Any

    def pictures(self, states: Iterable[int]) -> Iterator[Image.Image]:
        """Pictures of some of its states, which never go back, of the camera's size."""
        ...


def scene_of(rollout: Rollout, camera: Camera) -> Scene:
    """What can be shown of an episode."""
    if rollout.note:
        raise InputError(f"{rollout.note}; it can't be filmed, but jbrep inspect shows its signals")
    return Simulated(rollout, camera) if rollout.motion else Drawn(rollout, camera)


class Simulated:
    """The robot of MuJoCo, as a camera of its model sees it."""

    def __init__(self, rollout: Rollout, camera: Camera):
        assert rollout.motion is not None
        self._motion, self._camera = rollout.motion, camera
        places = [rollout.motion.arrays[name][0] for name in ("qpos", "mocap_pos", "mocap_quat")]
        self.start = rollout.task, [place.tolist() for place in places]
        self.timestep = rollout.task.known_timestep

    def pictures(self, states: Iterable[int]) -> Iterator[Image.Image]:
        for state in states:
            yield Image.fromarray(self._camera.picture(self._motion, state))


class Drawn:
    """What an environment draws by its own `render()`, while the episode is played once more.

    Where the time step is not known, its films have as many states a second as its metadata say.
    """

    def __init__(self, rollout: Rollout, camera: Camera):
        task = rollout.task
        if camera.name is not None:
            raise InputError(f"{task.name} draws itself, without a camera: leave out --camera")
        if not task.reproducible:
            raise InputError(
                f"{task.name} has no MuJoCo model and data, and is not reproducible: it can't be "
                "played again to be drawn; jbrep inspect shows signals"
            )
        self._rollout, self._size = rollout, (camera.width, camera.height)
        self.start = task, rollout.seed
        self._task = task.replace(arguments={**task.arguments, **_OWN})
        with self._begin() as lanes:
            self._draw(lanes)  # or it isn't possible
            fps = lanes.metadata.get("render_fps")
        self.timestep = task.timestep or (1 / fps if fps else task.known_timestep)

    def pictures(self, states: Iterable[int]) -> Iterator[Image.Image]:
        step = 0
        with self._begin() as lanes:
            for state in states:
                while step < state:
                    lanes.step(self._rollout.action[None, step])
                    step += 1
                    self._check_same(lanes, step)
                yield self._draw(lanes)

    def _begin(self) -> Lanes:
        """The environment at the start of the episode."""
        try:
            lanes = Lanes(self._task, 1)
        except InputError as error:
            raise self._not_drawn(str(error)) from error
        try:
            lanes.reset([0], [self._rollout.seed])
            self._check_same(lanes, 0)
        except BaseException:
            lanes.close()
            raise
        return lanes

    def _check_same(self, lanes: Lanes, state: int) -> None:
        seen = lanes.observation[0].astype(np.float32)
        if seen.tobytes() != self._rollout.observation[state].tobytes():
            raise self._not_drawn(f"played once more, it differs at step {state}")

    def _draw(self, lanes: Lanes) -> Image.Image:
        try:
            (drawn,) = lanes.render()
        except Exception as error:  # whatever the environment raises
            raise self._not_drawn(f"its render() fails: {kind_and_line(error)}") from error
        picture: Any = np.asarray(drawn)
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            given = f"{picture.dtype} {picture.shape}" if picture.ndim else repr(drawn)
            raise self._not_drawn(
                f"its render() gives {given}: it must be a picture, uint8 (height, width, 3)"
            )
        return ImageOps.pad(Image.fromarray(picture), self._size)

    def _not_drawn(self, why: str) -> InputError:
        return InputError(
            f"{self._rollout.task.name} has no MuJoCo model and data, and with "
            f"render_mode='rgb_array' it can't draw itself: {why}"
        )
