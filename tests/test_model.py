"""The MJCF against the robot's facts, written down here in the global frame."""

import mujoco
import numpy as np
import pytest

from jbrep.jitterbug.simulation import PHYSICS_STEPS, PHYSICS_TIMESTEP, fast_model, plain_model

STEEL, PLASTIC = 7700, 1100  # [kg/m^3]
ROD = 0.00061  # radius [m]

# body: list of (shape, its numbers, density); lengths in m, in the default pose
CORE = [
    ("box", ((0, 0, 0.040), (0.0055, 0.006, 0.011)), 38.5),
    ("box", ((0, 0, 0.021), (0.008, 0.006, 0.008)), 770),
    ("cylinder", ((0, 0, 0.026), (0, 0.012, 0.026), 0.002), STEEL),
    ("ellipsoid", ((0, 0.017, 0.026), (0.014, 0.006, 0.0005)), STEEL),
]
WEIGHT = [
    ("cylinder", ((0, -0.004, 0.050), (0, -0.004, 0.0625), 0.001), STEEL),
    ("ellipsoid", ((0.0043, -0.004, 0.061), (0.008, 0.010, 0.003)), STEEL),
]
BODIES = {"jitterbug": CORE, "weight": WEIGHT}
HINGES = {"motor": ((0, -0.004, 0.050), (0, 0, 1))}
for leg, side, back, height, inner, foot in (
    (1, 1, True, 0.068, (0.003, 0.0035, 0.049), 0.003),
    (2, 1, False, 0.070, (0.005, 0.0035, 0.050), 0.005),
    (3, -1, False, 0.070, (0.005, 0.0035, 0.050), 0.005),
    (4, -1, True, 0.068, (0.003, 0.0035, 0.049), 0.003),
):
    x, y = side * 0.0287, 0.0328 if back else -0.0308
    hip = (side * inner[0], *inner[1:])
    BODIES[f"leg{leg}_upper"] = [
        ("cylinder", ((x, y, height), hip, ROD), STEEL),
        ("sphere", ((x, y, height), ROD), STEEL),
    ]
    BODIES[f"leg{leg}_lower"] = [
        ("cylinder", ((x, y, foot), (x, y, height), ROD), STEEL),
        ("sphere", ((x, y, foot), 0.003), PLASTIC),
    ]
    axis = (side * (2.32 if back else -2.32), -2.68 if back else -3.68, 0)
    HINGES[f"leg{leg}_shoulder"] = ((side * 0.003, 0.0035, 0.049), axis)
    HINGES[f"leg{leg}_elbow"] = ((x, y, 0.068), axis)


def solid(shape, numbers, density):
    """Mass, centre and inertia about the centre of a homogeneous solid, by the book."""
    if shape == "cylinder":
        start, end, radius = map(np.asarray, numbers)
        along, length = end - start, np.linalg.norm(end - start)
        mass = density * np.pi * radius**2 * length
        direction = np.outer(along, along) / length**2
        thin = mass * (3 * radius**2 + length**2) / 12
        inertia = thin * np.eye(3) + (mass * radius**2 / 2 - thin) * direction
        return mass, (start + end) / 2, inertia
    centre = np.asarray(numbers[0])
    a, b, c = np.broadcast_to(numbers[1], 3)
    volume, share = (8 * a * b * c, 3) if shape == "box" else (4 / 3 * np.pi * a * b * c, 5)
    mass = density * volume
    return mass, centre, mass / share * np.diag([b**2 + c**2, a**2 + c**2, a**2 + b**2])


def rigid_body(solids):
    """Mass, centre of mass and inertia about it of solids fixed together."""
    masses, centres, inertias = zip(*(solid(*s) for s in solids), strict=True)
    mass = sum(masses)
    centre = sum(m * c for m, c in zip(masses, centres, strict=True)) / mass
    total = np.zeros((3, 3))
    for m, c, inertia in zip(masses, centres, inertias, strict=True):
        r = c - centre
        total += inertia + m * (r @ r * np.eye(3) - np.outer(r, r))
    return mass, centre, total


@pytest.fixture
def model():
    return plain_model()


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def test_the_robot_weighs_what_it_should(model):
    assert model.body("jitterbug").subtreemass[0] == pytest.approx(17.5165e-3, abs=5e-8)


@pytest.mark.parametrize("name", BODIES)
def test_mass_centre_and_inertia(model, data, name):
    mass, centre, inertia = rigid_body(BODIES[name])
    frame = data.body(name).ximat.reshape(3, 3)
    np.testing.assert_allclose(model.body(name).mass[0], mass, rtol=1e-9)
    np.testing.assert_allclose(data.body(name).xipos, centre, atol=1e-9)
    actual = frame @ np.diag(model.body(name).inertia) @ frame.T
    np.testing.assert_allclose(actual, inertia, atol=1e-6 * np.trace(inertia))


@pytest.mark.parametrize("name", HINGES)
def test_hinges(model, data, name):
    anchor, axis = HINGES[name]
    np.testing.assert_allclose(data.joint(name).xanchor, anchor, atol=1e-12)
    np.testing.assert_allclose(data.joint(name).xaxis, axis / np.linalg.norm(axis), atol=1e-12)
    spring = (0, 0) if name == "motor" else (0.4, 1e-5)
    assert (model.joint(name).stiffness[0], model.joint(name).damping[0]) == spring
    assert not model.joint(name).limited


def test_sizes_joint_order_and_options(model):
    names = [model.joint(i).name for i in range(model.njnt)]
    legs = [f"leg{leg}_{joint}" for leg in (2, 3, 1, 4) for joint in ("shoulder", "elbow")]
    assert names == ["root", *legs, "motor"]
    assert (model.nq, model.nv, model.nu, model.nsensordata) == (16, 15, 1, 3)
    assert model.opt.timestep == PHYSICS_TIMESTEP == 0.0002
    assert PHYSICS_STEPS == 50
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    default = mujoco.MjSpec().compile().opt
    for name in ("gravity", "density", "viscosity", "solver", "iterations", "disableflags", "cone"):
        np.testing.assert_array_equal(getattr(model.opt, name), getattr(default, name))
    np.testing.assert_array_equal(model.qpos0[:7], [0, 0, 0.035, 1, 0, 0, 0])
    np.testing.assert_array_equal(model.geom("floor").size[:2], [0.5, 0.5])
    cameras = {model.camera(i).name for i in range(model.ncam)}
    assert cameras == {"overhead", "tracking", "egocentric"}


def test_motor(model, data):
    data.ctrl[0] = 2  # clipped
    mujoco.mj_forward(model, data)
    assert data.joint("motor").qfrc_actuator[0] == pytest.approx(8.33e-3)
    data.joint("motor").qvel[0] = 1 / (0.8 * 0.00833)
    mujoco.mj_forward(model, data)
    assert data.joint("motor").qfrc_actuator[0] == pytest.approx(0, abs=1e-9)


def test_the_target_is_a_marker_that_touches_nothing(model, data):
    np.testing.assert_allclose(data.geom("target").xpos, [0, 0, 0.035])
    np.testing.assert_allclose(data.geom("target_pointer").xpos, [0.01, 0, 0.035])
    assert model.geom("target").size[0] == 0.01
    for name in ("target", "target_pointer"):
        assert model.geom(name).contype[0] == model.geom(name).conaffinity[0] == 0


def test_the_sensor_reads_the_velocity_of_the_body_s_centre_of_mass(model, data):
    data.joint("root").qvel[:] = [0.1, -0.2, 0.3, 1, 2, 3]
    mujoco.mj_forward(model, data)
    offset = data.body("jitterbug").xipos - data.body("jitterbug").xpos
    assert np.linalg.norm(offset) > 0.01
    expected = np.array([0.1, -0.2, 0.3]) + np.cross([1, 2, 3], offset)
    np.testing.assert_allclose(data.sensor("velocity").data, expected, atol=1e-12)


def drive(model, data, action, seconds):
    """Mean motor velocity over the second half."""
    velocities = []
    data.ctrl[0] = action
    for _ in range(round(seconds / PHYSICS_TIMESTEP)):
        mujoco.mj_step(model, data)
        velocities.append(data.joint("motor").qvel[0])
    return np.mean(velocities[len(velocities) // 2 :])


@pytest.mark.parametrize("action", [-0.6, 0.3, 1])
def test_constant_drive_spins_the_weight(model, data, action):
    assert drive(model, data, action, 2) == pytest.approx(145 * action, rel=0.05)


def test_without_drive_it_stands_still_and_upright(model, data):
    drive(model, data, 0, 2)
    assert np.abs(data.qvel[:14]).max() < 1e-3  # all but the weight, which turns freely
    assert abs(data.joint("motor").qvel[0]) < 0.5
    assert data.body("jitterbug").xmat[8] > 0.999
    assert np.linalg.norm(data.qpos[:3] - model.qpos0[:3]) < 0.003


def test_mirrored_drive_gives_mirrored_motion(model):
    def path(motor, action):
        data = mujoco.MjData(model)
        data.joint("motor").qpos[0] = motor
        data.ctrl[0] = action
        positions = []
        for _ in range(1000):  # 0.2 s; rounding grows into another motion later on
            mujoco.mj_step(model, data)
            positions.append(data.qpos[:3].copy())
        return np.array(positions)

    one, other = path(0.3, 0.7), path(np.pi - 0.3, -0.7)
    moved = np.ptp(one[:, 0])
    assert moved > 1e-3
    np.testing.assert_allclose(one * [-1, 1, 1], other, atol=0.02 * moved)


@pytest.mark.parametrize("kind", ["random", "constant", "alternating"])
def test_the_fast_model_moves_bit_for_bit_like_the_plain_one(kind):
    """From tilted starts, hard enough to tip the robot over."""
    random = np.random.default_rng(5)
    steps = np.arange(400)
    drives = {
        "random": random.uniform(-1, 1, (3, 400)),
        "constant": np.repeat([[0.5], [-0.8], [1.0]], 400, axis=1),
        "alternating": np.stack([np.sign(np.sin(steps * f)) for f in (0.3, 0.6, 1.2)]),
    }[kind]
    lowest = 1.0
    for actions in drives:
        start = random.normal(size=4) * [0, 0.02, 0.02, 0.5] + [1, 0, 0, 0]
        pair = []
        for model in (plain_model(), fast_model()):
            data = mujoco.MjData(model)
            data.qpos[3:7] = start
            states = []
            for action in actions:
                data.ctrl[0] = action
                mujoco.mj_step(model, data, nstep=PHYSICS_STEPS)
                states.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
                lowest = min(lowest, data.body("jitterbug").xmat[8])
            pair.append(np.array(states))
        np.testing.assert_array_equal(*pair)
    assert lowest < 0.99
