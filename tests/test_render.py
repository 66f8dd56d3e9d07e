"""Videos show the states that were simulated, at the time when they were."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from command import jbrep
from conftest import needs_egl
from PIL import Image

from jbrep.envs import describe
from jbrep.envs.make import make_env
from jbrep.envs.names import import_modules
from jbrep.envs.physics import physics_of
from jbrep.errors import InputError
from jbrep.jitterbug.simulation import plain_model
from jbrep.play.film import Film, Pace
from jbrep.play.pictures import Camera, band_height, find_camera
from jbrep.play.sources import find_episode

import_modules(["environments"])
SIZE = (96, 64)
SAMPLE = "data/sample/move_to_pose"


@pytest.fixture(scope="module")
def episode():
    return find_episode(SAMPLE)


@pytest.fixture(scope="module")
def camera():
    with Camera("tracking", *SIZE) as camera:
        yield camera


def render(*arguments):
    small = ("--size", "x".join(map(str, SIZE)), "--seconds", 0.2)
    return jbrep("render", *small, *arguments)


def same(frame, other, tolerance):
    return np.abs(frame.astype(float) - other).mean() < tolerance


@needs_egl
def test_an_mp4_from_the_command(tmp_path):
    import av

    render(SAMPLE, "--out", tmp_path / "new" / "a.mp4")
    with av.open(str(tmp_path / "new" / "a.mp4")) as container:
        (stream,) = container.streams.video
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        codec = stream.codec_context  # a browser asks for these
        assert (codec.name, codec.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 25)
    assert [frame.shape for frame in frames] == [(64, 96, 3)] * 5
    assert not same(frames[0], frames[-1], 2)
    assert [path.name for path in tmp_path.rglob("*.*")] == ["a.mp4"]
    content = (tmp_path / "new" / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # it plays while it loads


@needs_egl
def test_a_gif_from_the_command_loops(tmp_path):
    render(SAMPLE, "--out", tmp_path / "a.gif", "--fps", 30)
    with Image.open(tmp_path / "a.gif") as gif:
        frames, durations = [], []
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append(np.asarray(gif.convert("RGB")))
            durations.append(gif.info["duration"])
        assert (len(frames), frames[0].shape, gif.info["loop"]) == (6, (64, 96, 3), 0)
    assert durations == [30, 40, 30, 30, 40, 30]  # as near to 1/30 s as a GIF counts
    assert not same(frames[0], frames[-1], 2)


@needs_egl
def test_a_frame_shows_what_mujoco_renders(episode):
    model = plain_model()
    data = mujoco.MjData(model)
    arrays = episode.motion.arrays
    data.qpos[:] = arrays["qpos"][40]
    data.mocap_pos[:], data.mocap_quat[:] = arrays["mocap_pos"][40], arrays["mocap_quat"][40]
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 120, 160) as renderer:
        renderer.update_scene(data, "tracking")
        expected = renderer.render()
    with Camera("tracking", 160, 120) as camera:
        film = Film([episode, episode], camera, Pace(fps=5, seconds=0.6))
        frame = np.asarray(list(film.frames())[2])
    below = band_height(120)
    assert film.states.tolist() == [0, 20, 40]
    assert same(frame[below:, :158], expected[below:, :158], 3)
    assert same(frame[below:, 162:], expected[below:, 2:], 3)
    assert not same(frame[:below, :160], expected[:below], 20)


@needs_egl
@pytest.mark.parametrize("task", ["Reacher-v5", "dm_control/cheetah-run-v0"])
def test_any_robot_of_mujoco_is_filmed(task):
    episode = find_episode("uniform", 0, describe(task, episode_steps=30))
    with Camera(None, *SIZE) as camera:
        film = Film([episode], camera, Pace(fps=50))
        assert film.seconds == pytest.approx(len(episode) * episode.task.timestep, abs=0.01)
        first, *_, last = [np.asarray(frame)[band_height(SIZE[1]) :] for frame in film.frames()]
    moved = np.abs(first.astype(int) - last).max(axis=2) > 40
    assert 0.002 < moved.mean() < 0.5  # the robot, not its surroundings


def test_a_camera_that_follows_the_robot():
    """The model's own one, or else from aside: Reacher's model has none."""
    pytest.importorskip("shimmy")
    for name, kind in (("Hopper-v5", 0), ("dm_control/cheetah-run-v0", 0), ("face_direction", 1)):
        assert find_camera(physics_of(make_env(name, {})).model, None) == kind
    model = physics_of(make_env("Reacher-v5", {})).model
    assert model.body(find_camera(model, None).trackbodyid).name == "body0"


@needs_egl
def test_what_can_t_be_filmed(camera):
    episode = find_episode("uniform", 0, describe("Hopper-v5", episode_steps=3))
    timeless = episode.task.replace(timestep=None)
    for change in ({"note": "It differs"}, {"task": timeless}):
        with pytest.raises(InputError, match=r"It differs|time step"):
            Film([replace(episode, **change)], camera, Pace())


@needs_egl
def test_what_nobody_draws_is_refused(tmp_path):
    told = render("uniform", "--task", "Sledges/Sledge-v0", "--out", tmp_path / "new" / "a.mp4")
    assert (told.exit_code, "no MuJoCo" in told.stderr) == (2, True)
    assert not list(tmp_path.iterdir())


@needs_egl
@pytest.mark.parametrize(
    ("pace", "frames", "last"),
    [(Pace(), 250, 996), (Pace(speed=2), 125, 992), (Pace(50, 0.5), 1000, 999)],
)
def test_speed_and_frames(pace, frames, last, episode, camera):
    film = Film([episode], camera, pace)
    assert (len(film), len(film.states), film.states[-1]) == (frames, frames, last)
    assert film.seconds == pytest.approx(10 / pace.speed)


@needs_egl
def test_a_mistake_is_one_line_and_exit_code_2(tmp_path, monkeypatch):
    data = Path("data").resolve()
    monkeypatch.chdir(tmp_path)
    Path("data").symlink_to(data)
    Path("there.mp4").touch()
    for named, *arguments in (
        *(("a.avi", "--out", "a.avi"), ("there.mp4", "--out", "there.mp4")),
        *(("camera", "--camera", "side"), ("640x480", "--size", "640")),
        *(("641x480", "--size", "641x480"), ("fps", "--fps", 0), ("speed", "--speed", "nan")),
        *(("episode 4", "--episode", 4), ("wide", "--size", "3840x64", "uniform", "uniform")),
    ):
        result = render(SAMPLE, "--task", "move_to_pose", "--out", "a.mp4", *arguments)
        assert result.exit_code == 2
        assert named in result.stderr.splitlines()[-1]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "there.mp4"]
