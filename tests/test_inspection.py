"""Recordings hold what they were made from, as Rerun's own reader finds it."""

import re
import subprocess
from pathlib import Path

import mujoco
import numpy as np
import pytest
from command import jbrep
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.inspection import inspect
from jbrep.inspection.robot import Robot, shapes
from jbrep.inspection.scene import shades
from jbrep.inspection.subject import POINTS, SPACING, sweep
from jbrep.play.sources import find_episode

FACE, POSE = "data/sample/face_direction", "data/sample/move_to_pose"
DAE = "jbrep/encoders/shipped/face_direction/dae-4.safetensors"
ROWS = 1001


def read(path):
    """The columns of each entity by name, as Rerun reads them."""
    found = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, {}).update(columns(chunk))
    return found


def columns(chunk):
    batch = chunk.to_record_batch()
    return dict(zip(batch.schema.names, batch.columns, strict=True))


def values(entity, name):
    return np.array(entity[name].to_pylist())


def scalars(entity):
    return values(entity, "Scalars:scalars")


def names(entity):
    return entity["SeriesLines:names"].to_pylist()[0]


def poses(entity):
    """Positions (n, 3) and quaternions (n, 4), w first."""
    turned = values(entity, "Transform3D:quaternion")[:, 0]
    return values(entity, "Transform3D:translation")[:, 0], turned[:, [3, 0, 1, 2]]


@pytest.fixture(scope="module")
def robot(rollout):
    return Robot(rollout.motion.model)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("inspection")


@pytest.fixture(scope="module")
def rollout():
    return find_episode(FACE, 1)


@pytest.fixture(scope="module")
def recorded(folder):
    return inspect(FACE, 1, encoder="dae-8", out=folder / "dae-8.rrd")


@pytest.fixture(scope="module")
def entities(recorded):
    return read(recorded)


@pytest.fixture(scope="module")
def traversed(folder):
    return inspect(FACE, 1, encoder="dae-8", traverse=True, out=folder / "traverse.rrd")


def test_every_body_and_geom_of_the_model_is_there(entities, robot):
    assert len(robot.bodies) == 10
    for body in robot.bodies:
        entity = entities[f"/world/robot/{robot.names[body]}"]
        for part in (*poses(entity), entity["step"], entity["time"]):
            assert len(part) == ROWS
        drawn = [name for name in entity if name.endswith(":colors")]
        assert sum(len(entity[name].to_pylist()[0]) for name in drawn) == len(robot.geoms(body))
    assert sum(len(robot.geoms(body)) for body in robot.bodies) == 22
    assert "/world/surroundings/target" in entities
    assert values(entities["/world/surroundings/target"], "Ellipsoids3D:colors").shape == (1, 2)


def test_poses_are_the_episodes(entities, rollout):
    motion = rollout.motion
    position, quaternion = poses(entities["/world/robot/jitterbug"])
    np.testing.assert_array_equal(position, motion.qpos[:, :3].astype(np.float32))
    np.testing.assert_allclose(quaternion, motion.qpos[:, 3:7], atol=1e-7)
    target, turned = poses(entities["/world/surroundings/target"])
    np.testing.assert_allclose(target[0], motion.arrays["mocap_pos"][0, 0], atol=1e-7)
    np.testing.assert_allclose(turned[0], motion.arrays["mocap_quat"][0, 0], atol=1e-7)


def test_series_are_the_episodes(entities, rollout):
    task = rollout.task
    for group, place in task.groups.items():
        entity = entities[f"/observation/{group}"]
        np.testing.assert_array_equal(scalars(entity), rollout.observation[:, place])
        assert names(entity) == [f"{f.name} [{f.unit}]" for f in task.features[place]]
    np.testing.assert_array_equal(scalars(entities["/action"]), rollout.action)
    assert names(entities["/action"]) == ["action_0 [-1, 1]"]
    np.testing.assert_array_equal(scalars(entities["/reward/total"])[:, 0], rollout.reward)
    assert entities["/action"]["step"].to_numpy()[-1] == ROWS - 2
    assert entities["/reward/total"]["step"].to_numpy()[0] == 1  # of the state that it led to
    time = entity["time"].to_numpy(zero_copy_only=False) / np.timedelta64(10, "ms")
    np.testing.assert_array_equal(time, np.arange(ROWS))


def test_what_is_decoded(entities, rollout):
    encoder, task, qpos = find("dae-8", rollout.task), rollout.task, rollout.motion.qpos
    latent = encoder.encode(rollout.observation)
    decoded = encoder.decode(latent).astype(float)
    np.testing.assert_array_equal(scalars(entities["/latent/units"]), latent)
    errors = (decoded - rollout.observation) / encoder.scaler.half_width
    for name, part in task.split(decoded).items():
        np.testing.assert_array_equal(scalars(entities[f"/reconstruction/{name}"]), part)
        error = scalars(entities[f"/error/{name}"])
        np.testing.assert_allclose(error, task.split(errors)[name], rtol=1e-5, atol=1e-7)
    total = np.sqrt(np.mean(errors**2, axis=1))
    np.testing.assert_allclose(scalars(entities["/error/total"])[:, 0], total)
    position, quaternion = poses(entities["/world/ghost/jitterbug"])
    np.testing.assert_array_equal(position, decoded[:, :3].astype(np.float32))
    length = np.linalg.norm(decoded[:, 3:7], axis=1, keepdims=True)
    np.testing.assert_allclose(quaternion, decoded[:, 3:7] / length, atol=1e-6)
    half = (decoded[:, 13] - np.pi / 2) / 2  # of the weight's turn about the vertical of the body
    turned = Rotation.from_quat(np.column_stack((0 * half, 0 * half, np.sin(half), np.cos(half))))
    there, body = (
        Rotation.from_quat(poses(entities[f"/world/ghost/{name}"])[1], scalar_first=True)
        for name in ("weight", "jitterbug")
    )
    np.testing.assert_allclose((there.inv() * body * turned).magnitude(), 0, atol=1e-5)
    apart = np.linalg.norm(decoded[:, :3] - qpos[:, :3], axis=1)
    bodies = entities["/error/bodies"]
    assert names(bodies)[0] == "jitterbug [mm]"
    np.testing.assert_allclose(scalars(bodies)[:, 0], 1e3 * apart)
    shown = values(entities["/world/ghost/jitterbug"], "Boxes3D:colors")[:, 0]
    expected = shades(apart).astype(np.uint32) @ (1 << np.array([24, 16, 8, 0], np.uint32))
    np.testing.assert_array_equal(shown, expected)  # not one for all times, which would win


def identity(path):
    return RrdReader(path).recordings()[0].recording_id


def test_the_same_inputs_give_the_same_content(recorded, entities, folder):
    again = inspect(FACE, 1, encoder="dae-8", out=folder / "again.rrd")
    other = inspect(FACE, 1, out=folder / "other.rrd")
    assert identity(again) == identity(recorded) != identity(other)
    found = read(again)
    assert {*found} == {*entities}
    for path, entity in entities.items():
        for name, column in entity.items():
            same = repr(column.to_pylist()) == repr(found[path][name].to_pylist())  # also of NaN
            assert same or name == "rerun.controls.RowId", (path, name)


def test_a_traversal_shows_what_each_unit_decodes_to(traversed, rollout):
    encoder, found = find("dae-8", rollout.task), read(traversed)
    latent = encoder.encode(rollout.observation)
    swept = sweep(latent)
    assert swept.shape == (8, POINTS, 8)
    for unit in range(8):
        ends = np.percentile(latent[:, unit], (1, 99))
        np.testing.assert_allclose(swept[unit, [0, -1], unit], ends, rtol=1e-5, atol=1e-6)
        others = np.delete(np.median(latent, axis=0), unit)
        still = np.delete(swept[unit], unit, axis=1)
        np.testing.assert_allclose(still, np.tile(others, (POINTS, 1)), rtol=1e-6)
        decoded = encoder.decode(swept[unit])
        scaled = encoder.scaler.scale(decoded)
        series = found[f"/traverse/unit_{unit}/decoded"]
        np.testing.assert_allclose(scalars(series), scaled, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(series["traverse"].to_numpy(), np.arange(POINTS))
        most = encoder.task.feature_names[np.ptp(scaled, axis=0).argmax()]
        assert names(found[f"/traverse/unit_{unit}/most"])[0] == f"{most} [scaled]"
        position, quaternion = poses(found[f"/world/unit_{unit}/jitterbug"])
        np.testing.assert_allclose(position[:, 0], SPACING * (unit - 3.5), atol=1e-6)
        np.testing.assert_allclose(position[:, 2], decoded[:, 2], rtol=1e-6)
        assert len(quaternion) == POINTS


@pytest.fixture(scope="module")
def short(folder):
    """Recordings of episodes of at most 30 steps under uniformly random actions."""

    def make(name, **given):
        task = describe(name, episode_steps=30)
        path = inspect("uniform", 0, task, out=folder / f"{task.slug}.rrd", **given)
        return find_episode("uniform", 0, task), read(path)

    return make


def test_any_robot_of_mujoco_is_recorded(short):
    rollout, found = short("Hopper-v5", encoder="full")
    robot, rows = Robot(rollout.motion.model), len(rollout) + 1
    assert robot.names[robot.root] == "torso"
    data = mujoco.MjData(robot.model)
    rollout.motion.put(data, rows - 1)
    mujoco.mj_kinematics(robot.model, data)
    for body in robot.bodies:
        position, quaternion = poses(found[f"/world/robot/{robot.names[body]}"])
        assert len(position) == rows
        np.testing.assert_allclose(position[-1], data.xpos[body], atol=1e-6)
        np.testing.assert_allclose(quaternion[-1], data.xquat[body], atol=1e-6)
    np.testing.assert_array_equal(scalars(found["/action"]), rollout.action)
    np.testing.assert_array_equal(scalars(found["/reward/total"])[:, 0], rollout.reward)
    end = found["/reward/total"]["time"].to_pylist()[-1].total_seconds()
    assert end == pytest.approx(len(rollout) * rollout.task.timestep)
    group = next(iter(rollout.task.groups))
    there, back = (scalars(found[f"/{what}/{group}"]) for what in ("observation", "reconstruction"))
    np.testing.assert_allclose(back, there)
    assert not {"/world/ghost", "/error/bodies"} & {*found}


def test_a_robot_without_mujoco_shows_its_signals(short):
    rollout, found = short("Pendulum-v1", encoder="full")
    np.testing.assert_array_equal(scalars(found["/observation/obs"]), rollout.observation)
    assert names(found["/observation/obs"]) == ["obs_0", "obs_1", "obs_2"]
    assert scalars(found["/error/total"]).max() < 1e-6
    assert not any(path.startswith("/world") for path in found)


SHAPES = """
<mujoco>
  <asset>
    <material name="green" rgba="0 1 0 1"/>
    <mesh name="wedge" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/>
  </asset>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    <body name="a/b" pos="0 0 1">
      <freejoint/>
      <geom name="ball" type="sphere" size=".1" material="green"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .3" rgba="1 0 0 1" material="green"/>
      <geom name="pill" type="capsule" size=".05 .2" pos="1 2 3" euler="90 0 0"/>
      <geom name="can" type="cylinder" size=".05 .2"/>
      <geom name="brick" type="box" size=".1 .2 .3"/>
      <geom name="stone" type="mesh" mesh="wedge" pos="0 0 .5" euler="0 90 0"/>
      <geom name="hidden" type="box" size="1 1 1" group="3"/>
      <geom name="clear" type="box" size="1 1 1" rgba="1 1 1 0"/>
      <body name="bare"/>
    </body>
    <body><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""


def test_shapes_of_every_kind():
    model = mujoco.MjModel.from_xml_string(SHAPES)
    robot = Robot(model)
    assert robot.names == ["world", "a_b", "bare", "body_3"]
    assert (robot.bodies, robot.others) == ([1, 2], [0, 3])
    geoms = robot.geoms(1)
    drawn = [model.geom(geom).name for geom in geoms]
    assert drawn == ["ball", "egg", "pill", "can", "brick", "stone"]
    colours = robot.colours[geoms]
    assert colours[:3, :3].tolist() == [[0, 255, 0], [255, 0, 0], [128, 128, 128]]
    found = {type(each).__name__: each for each in shapes(model, geoms, colours)}
    halves = found["Ellipsoids3D"].half_sizes.as_arrow_array().to_pylist()
    np.testing.assert_allclose(halves, [[0.1] * 3, [0.1, 0.2, 0.3]], rtol=1e-6)
    assert {*found} == {"Ellipsoids3D", "Capsules3D", "Cylinders3D", "Boxes3D", "Mesh3D"}
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    pill = model.geom("pill").id
    begin = np.ravel(found["Capsules3D"].translations.as_arrow_array().to_pylist())
    axis = data.geom_xmat[pill].reshape(3, 3)[:, 2]
    up = np.array([0, 0, 1])  # from the body's frame to the world's
    np.testing.assert_allclose(begin + up, data.geom_xpos[pill] - 0.2 * axis, atol=1e-6)
    stone, mesh = model.geom("stone").id, found["Mesh3D"]
    corners = np.array(mesh.vertex_positions.as_arrow_array().to_pylist()) + up
    expected = model.mesh_vert @ data.geom_xmat[stone].reshape(3, 3).T + data.geom_xpos[stone]
    apart = np.linalg.norm(corners[:, None] - expected, axis=2)
    np.testing.assert_allclose(apart.min(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(apart.min(axis=1), 0, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, "SOURCE"),
        ({"source": FACE, "episode": 9}, "episode 9"),
        ({"source": FACE, "task": describe("move_to_pose")}, "move_to_pose"),
        ({"source": FACE, "traverse": True}, "traverse"),
        ({"encoder": "dae-8"}, "task"),
        ({"source": POSE, "encoder": DAE}, "dae-4"),
    ],
)
def test_mistakes(given, named):
    with pytest.raises(InputError, match=re.escape(named)):
        inspect(**given)


def test_an_earlier_recording_is_overwritten_and_nothing_else(tmp_path):
    out = tmp_path / "it.rrd"
    out.write_text("mine")
    with pytest.raises(InputError, match=r"\.rrd"):
        inspect(FACE, out=out)
    assert out.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [out]
    out.write_bytes(b"RRF2 an earlier one")
    inspect(FACE, out=out)
    assert "/world/robot/jitterbug" in read(out)


def test_the_command_names_the_file_after_its_content(tmp_path, monkeypatch):
    (tmp_path / "data").symlink_to(Path("data").resolve())
    monkeypatch.chdir(tmp_path)
    told = jbrep("inspect", FACE, "--episode", 1, "--encoder", "dae-8").output
    path = "inspect/face_direction-data-sample-episode-1-dae-8.rrd"
    assert told.endswith(f"{path}\n")
    assert len(read(tmp_path / path)["/observation/position"]["step"]) == ROWS


def test_the_viewer_is_rerun_itself(brief, tmp_path, monkeypatch):
    called = []

    def run(command, **given):
        called.append(command)
        return subprocess.CompletedProcess(command, 3)

    monkeypatch.setattr("jbrep.cli.view.subprocess.run", run)
    out = tmp_path / "it.rrd"
    assert jbrep("inspect", brief, "--out", out, "--view").exit_code == 2
    assert called[0][1:] == ["-m", "rerun", "--bind", "127.0.0.1", str(out)]
