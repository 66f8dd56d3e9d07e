"""Drawn bodies: their spreads, their geometry, and that they are robots that can run."""

import mujoco
import numpy as np
import pytest
from command import refused

from jbrep.jitterbug import bodies
from jbrep.jitterbug.bodies import check_body, draw, number_of
from jbrep.jitterbug.simulation import plain_model

NUMBERS = (0, 2**31 - 1)
DRAWN = ("knees", "feet", "weight", "weight_size", "densities", "gear")


def at_rest(body=None):
    """A body's model, and its data in the default pose."""
    model = plain_model(body)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def ends(model, data, name):
    """The two ends of a rod, in the world, (2, 3)."""
    geom = data.geom(name)
    half = geom.xmat.reshape(3, 3)[:, 2] * model.geom(name).size[1]
    return geom.xpos - half, geom.xpos + half


@pytest.fixture(scope="module")
def many():
    return [draw(number, materials=True) for number in range(500)]


def test_a_number_gives_the_same_body_and_another_number_another():
    one, same, other = draw(7, True), draw(7, True), draw(8, True)
    assert one == same != other
    assert hash(one) == hash(same)
    for name in DRAWN:
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
        assert np.not_equal(getattr(one, name), getattr(other, name)).all()


@pytest.mark.parametrize(
    ("name", "spread", "off"),
    [
        ("knees", [0.003, 0.003, 0.002], 0.2),  # less in front, where the weight would strike
        ("feet", [0.003, 0.003, 0.002], 0.1),
        ("weight_size", 0.0007, 0.15),
        ("densities", [10, 80, 200], 0.1),
        ("gear", 0.001, 0.1),
    ],
)
def test_spreads_are_the_authors(many, name, spread, off):
    values = np.array([getattr(body, name) for body in many])
    np.testing.assert_allclose(values.std(axis=0) / spread, 1, atol=off)
    np.testing.assert_allclose(values.mean(axis=0) / spread, 0, atol=0.3)


def test_the_weight_is_shifted_by_at_most_a_millimetre_back_and_down(many):
    shifts = np.array([body.weight for body in many])
    np.testing.assert_allclose(shifts[:, 0].std(), 0.0015, rtol=0.15)
    assert (shifts[:, 1:].min(axis=0) == -0.001).all()
    assert (shifts[:, 1:].max(axis=0) > [0.003, 0.002]).all()
    assert shifts[:, 0].min() < -0.003


@pytest.mark.parametrize("number", NUMBERS)
def test_knees_feet_and_weight_are_where_they_were_shifted_to(number):
    body = draw(number)
    (published, before), (model, data) = at_rest(), at_rest(body)
    lift = [0, 0, model.qpos0[2] - published.qpos0[2]]
    for leg, knee, foot in zip((1, 2, 3, 4), body.knees, body.feet, strict=True):
        for name, shift in (("knee", knee), ("foot", foot)):
            moved = data.geom(f"leg{leg}_{name}").xpos - before.geom(f"leg{leg}_{name}").xpos
            np.testing.assert_allclose(moved, shift + lift, atol=1e-12)
        elbow = data.joint(f"leg{leg}_elbow").xanchor - before.joint(f"leg{leg}_elbow").xanchor
        np.testing.assert_allclose(elbow, knee + lift, atol=1e-12)
        shoulder = f"leg{leg}_shoulder"
        hip = data.joint(shoulder).xanchor - before.joint(shoulder).xanchor
        np.testing.assert_allclose(hip, lift, atol=1e-12)
    moved = data.geom("weight").xpos - before.geom("weight").xpos
    np.testing.assert_allclose(moved, body.weight + lift, atol=1e-12)
    grown = model.geom("weight").size - published.geom("weight").size
    np.testing.assert_allclose(grown, body.weight_size, atol=1e-12)


@pytest.mark.parametrize("number", NUMBERS)
def test_rods_join_at_the_knees_and_end_at_hips_and_feet(number):
    published, model, data = at_rest()[1], *at_rest(draw(number))
    lift = [0, 0, data.qpos[2] - published.qpos[2]]
    for leg in (1, 2, 3, 4):
        knee, foot = data.geom(f"leg{leg}_knee").xpos, data.geom(f"leg{leg}_foot").xpos
        hip = ends(plain_model(), published, f"leg{leg}_upper")
        upper, lower = (ends(model, data, f"leg{leg}_{part}") for part in ("upper", "lower"))
        for point, rod in ((knee, upper), (knee, lower), (foot, lower)):
            assert min(np.linalg.norm(end - point) for end in rod) < 1e-9
        inner = min(hip, key=lambda end: np.hypot(*end[:2]))
        assert min(np.linalg.norm(end - inner - lift) for end in upper) < 1e-9


@pytest.mark.parametrize("number", NUMBERS)
def test_hinges_are_perpendicular_to_their_leg(number):
    published, model, data = at_rest()[1], *at_rest(draw(number))
    for leg in (1, 2, 3, 4):
        upper, lower = (
            np.subtract(*ends(model, data, f"leg{leg}_{p}")) for p in ("upper", "lower")
        )
        shoulder, elbow = data.joint(f"leg{leg}_shoulder"), data.joint(f"leg{leg}_elbow")
        for hinge, legs in ((shoulder, [upper, (0, 0, 1)]), (elbow, [upper, lower])):
            np.testing.assert_allclose(np.linalg.norm(hinge.xaxis), 1)
            np.testing.assert_allclose(legs @ hinge.xaxis, 0, atol=1e-12)
            assert (
                hinge.xaxis @ published.joint(hinge.name).xaxis > 0.8
            )  # the published ones are off by up to 23 degrees


@pytest.mark.parametrize("number", range(3))
def test_the_lowest_foot_touches_the_floor_at_the_start(number):
    model, data = at_rest(draw(number))
    heights = [data.geom(f"leg{leg}_foot").xpos[2] for leg in (1, 2, 3, 4)]
    assert min(heights) == pytest.approx(model.geom("leg1_foot").size[0], abs=1e-12)


def test_the_weight_clears_the_legs_all_the_way_round():
    """Half a millimetre, and a little less where the ellipsoid of the clearance is short of it."""
    random = np.random.default_rng(0)
    assert any(bodies._draw(0, random).strikes() for _ in range(50))
    for number in range(12):
        model, data = at_rest(draw(number))
        weight = model.geom("weight").id
        for data.joint("motor").qpos[0] in np.linspace(-np.pi, np.pi, 60):
            mujoco.mj_kinematics(model, data)
            for leg in (2, 3):
                rod = model.geom(f"leg{leg}_upper").id
                assert mujoco.mj_geomDistance(model, data, weight, rod, 1, None) > 0.0003


def test_densities_and_gear_are_the_materials():
    body = draw(7, materials=True)
    (plain, _), (made, _) = at_rest(draw(7)), at_rest(body)
    core, block, steel = body.densities
    for name in ("leg2_upper", "weight"):
        ratio = made.body(name).mass[0] / plain.body(name).mass[0]
        assert ratio == pytest.approx(1 + steel / 7700)
    volumes = {
        core: 8 * np.prod(plain.geom("core_upper").size),
        block: 8 * np.prod(plain.geom("core_lower").size),
        steel: np.pi * 0.002**2 * 0.012 + 4 / 3 * np.pi * np.prod(plain.geom("crank_handle").size),
    }
    gained = made.body("jitterbug").mass[0] - plain.body("jitterbug").mass[0]
    assert gained == pytest.approx(sum(change * volume for change, volume in volumes.items()))
    assert made.actuator("motor").gear[0] == pytest.approx(0.00833 + body.gear)


def test_bodies_that_exist_and_others():
    for body in (None, "random", 0, 2**31 - 1):
        check_body(body, materials=True)
        assert number_of(body, np.random.default_rng(0)) in range(-1, 2**31)
    for body in (-1, 2**31, 7.0, "other", True):
        assert "body" in refused(check_body, body, False)
    assert "materials" in refused(check_body, 7, 1)
