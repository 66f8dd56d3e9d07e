"""Gymnasium: ids, checkers, forms, time limit, seeds and divergence."""

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from command import refused
from conftest import HEADLESS, needs_egl
from gymnasium.envs.mujoco.utils import check_mujoco_reset_state
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from jbrep.errors import InputError
from jbrep.jitterbug import JitterbugVectorEnv, environment_id
from jbrep.jitterbug.tasks import TASKS

IDS = [environment_id(task) for task in TASKS]
FACE = environment_id("face_direction")


def test_the_ids():
    names = ("MoveFromOrigin", "FaceDirection", "MoveInDirection", "MoveToPosition", "MoveToPose")
    assert [f"Jitterbug/{name}-v0" for name in names] == IDS


@pytest.mark.filterwarnings("ignore:.*-?infinity. This is probably too")  # no state is bounded
@pytest.mark.parametrize("env_id", [FACE, IDS[-1]])
def test_checkers(env_id):
    environment = gymnasium.make(env_id)
    check_env(environment.unwrapped, skip_render_check=env_id != FACE or not HEADLESS)
    check_mujoco_reset_state(environment)
    sb3_check_env(environment)


def test_scaled_observations():
    task, found = TASKS["move_to_pose"], []
    for scaled in (False, True):
        environment = gymnasium.make(environment_id(task.name), scaled=scaled)
        environment.reset(seed=2)
        found.append(environment.step(np.array([0.7], np.float32))[0])
    np.testing.assert_allclose(found[1], task.plain.scale(found[0]), rtol=1e-5, atol=1e-6)


def test_the_time_limit_truncates_and_never_terminates(monkeypatch):
    monkeypatch.setattr("jbrep.jitterbug.simulation.Simulation.step", lambda *_: np.zeros(1, bool))
    environment = gymnasium.make(FACE)
    environment.reset(seed=0)
    ends = [environment.step(environment.action_space.sample())[2:4] for _ in range(1000)]
    assert not any(terminated for terminated, _ in ends)
    assert [truncated for _, truncated in ends] == [False] * 999 + [True]


def test_many_robots_are_one_repeated_with_its_own_seed():
    many = gymnasium.make_vec(FACE, num_envs=3, max_episode_steps=40)
    assert isinstance(many, JitterbugVectorEnv)
    singles = [gymnasium.make(FACE, max_episode_steps=40) for _ in range(3)]
    observation, _ = many.reset(seed=7)
    for index, single in enumerate(singles):
        np.testing.assert_array_equal(observation[index], single.reset(seed=7 + index)[0])
    random = np.random.default_rng(0)
    for step in range(1, 101):
        actions = random.uniform(-1, 1, (3, 1)).astype(np.float32)
        observation, reward, terminated, truncated, info = many.step(actions)
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (step % 40 == 0)
        for index, single in enumerate(singles):
            one = single.step(actions[index])
            assert reward[index] == one[1]
            assert truncated[index] == one[3]
            if truncated[index]:
                np.testing.assert_array_equal(info["final_obs"][index], one[0])
                one = single.reset()
            np.testing.assert_array_equal(observation[index], one[0])


def test_a_robot_that_diverges_is_truncated_and_flagged():
    environment = gymnasium.make(FACE)
    environment.reset(seed=0)
    before = environment.step(np.zeros(1, np.float32))
    assert before[4] == {"non_finite": False}
    environment.unwrapped._simulation.readings.qvel[0, 0] = np.nan
    observation, reward, terminated, truncated, info = environment.step(np.zeros(1, np.float32))
    np.testing.assert_array_equal(observation, before[0])
    assert (reward, terminated, truncated) == (0, False, True)
    assert info["non_finite"]


def test_a_environment_that_diverges_starts_anew_alone():
    many = gymnasium.make_vec(FACE, num_envs=3)
    many.reset(seed=0)
    many.step(np.zeros((3, 1)))
    many.unwrapped.simulation.readings.qvel[1, 0] = np.inf
    observation, reward, terminated, truncated, info = many.step(np.zeros((3, 1)))
    np.testing.assert_array_equal(truncated, [False, True, False])
    assert reward[1] == 0
    assert not terminated.any()
    np.testing.assert_array_equal(info["final_info"]["non_finite"], truncated)
    assert np.isfinite(observation).all()
    assert np.isfinite(info["final_obs"][1]).all()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Gymnasium's viewer
def test_missing_opengl_is_said_in_one_line_and_all_else_works(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    environment = gymnasium.make(FACE, render_mode="rgb_array").unwrapped
    environment.reset(seed=0)
    with pytest.raises(InputError, match=r"rendering needs EGL.* set MUJOCO_GL=egl"):
        environment.render()
    assert environment.step(np.zeros(1))[0].shape == (16,)


def test_mistakes_are_named():
    next_step = gymnasium.vector.AutoresetMode.NEXT_STEP
    assert str(next_step) in refused(lambda: gymnasium.make_vec(FACE, autoreset_mode=next_step))
    assert "side" in refused(lambda: gymnasium.make(FACE, camera="side"))
    many = gymnasium.make_vec(FACE, num_envs=2)
    assert "3 seeds for 2 environments" in refused(lambda: many.reset(seed=[1, 2, 3]))
    many.reset()
    assert "(2, 1)" in refused(many.step, np.zeros(2))
    single = gymnasium.make(FACE).unwrapped
    single.reset()
    assert "not finite" in refused(single.step, np.array([np.nan]))


def without_a_display(code):
    """Run it as on a machine without a display, where nobody has set MUJOCO_GL."""
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")
    env = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-c", f"import gymnasium, jbrep\n{code}"]
    return subprocess.run(command, env=env, capture_output=True, text=True)


@needs_egl
def test_frames_need_neither_a_display_nor_a_setting_and_triton_can_be_imported_after_them():
    """Torch does so with its first optimiser; where Mesa renders, the process crashed."""
    pytest.importorskip("triton")
    done = without_a_display(
        f"env = gymnasium.make('{FACE}', render_mode='rgb_array', width=64, height=48)\n"
        "env.reset(seed=0)\nprint(env.render().shape)\nimport triton"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "(48, 64, 3)\n", done.stderr


def test_a_window_without_a_display_is_refused_in_one_line():
    done = without_a_display(f"gymnasium.make('{FACE}', render_mode='human')")
    assert done.returncode == 1  # an abort of the process has another
    assert "jbrep.errors.InputError: render_mode 'human'" in done.stderr.splitlines()[-1]


def test_environments_are_reset_by_hand_where_autoreset_is_off():
    """By the mask, with seeds of their own; the others go on, those that have ended too."""
    off = gymnasium.vector.AutoresetMode.DISABLED
    many = gymnasium.make_vec(FACE, num_envs=3, max_episode_steps=5, autoreset_mode=off)
    assert many.metadata["autoreset_mode"] is off
    many.reset(seed=[4, 5, 6])
    actions = np.random.default_rng(0).uniform(-1, 1, (8, 3, 1)).astype(np.float32)
    for action in actions[:5]:
        observation, _, _, truncated, info = many.step(action)
    assert truncated.all()
    assert "final_obs" not in info
    mask = {"reset_mask": np.array([False, True, False])}
    again, _ = many.reset(seed=[None, 9, None], options=mask)
    np.testing.assert_array_equal(again[[0, 2]], observation[[0, 2]])
    single = gymnasium.make(FACE, max_episode_steps=5)
    np.testing.assert_array_equal(again[1], single.reset(seed=9)[0])
    for action in actions[5:]:
        observation, _, _, truncated, _ = many.step(action)
        np.testing.assert_array_equal(observation[1], single.step(action[1])[0])
        assert truncated.tolist() == [True, False, True]


_WITHOUT = """
import sys
sys.modules["dm_control"] = None  # as if it weren't installed
import gymnasium, jbrep
from jbrep import jitterbug
from jbrep.errors import InputError
print(gymnasium.make("jbrep:Jitterbug/MoveToPose-v0").reset(seed=0)[0].shape)
print(gymnasium.make_vec("Jitterbug/MoveToPose-v0", num_envs=3).reset(seed=0)[0].shape)
try:
    jitterbug.load("move_to_pose")
except InputError as error:
    print(error)
"""


def test_the_dm_control_domain_alone_needs_dm_control():
    done = subprocess.run([sys.executable, "-c", _WITHOUT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    one, many, said = done.stdout.splitlines()
    assert (one, many) == ("(19,)", "(3, 19)")
    assert said.startswith("a dm_control environment needs dm_control: pip install 'jbrep[dm-")
