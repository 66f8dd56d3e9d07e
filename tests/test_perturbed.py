"""What episodes draw: sensors, motors, bodies and physics, by their seeds alone."""

import json

import gymnasium
import mujoco
import numpy as np
import pytest
from command import jbrep, mistake, refused
from gymnasium.envs.registration import EnvSpec
from small import assert_same_files, stopping

from jbrep.dataset import DataSettings
from jbrep.envs import Environments, describe
from jbrep.envs.autoreset import AutoresetEnvironments
from jbrep.envs.description import with_domain
from jbrep.envs.domain import Domain, Draws, read_ranges
from jbrep.envs.physics import put_factors, velocity_after
from jbrep.envs.view import with_view
from jbrep.play.perturbed import domains_of
from jbrep.play.sources import find_player
from jbrep.rl import Run, StoppedError, train
from jbrep.rl.files import EPISODES, EVALUATIONS, last_returns, read_evaluations, read_run

TASKS = {name: describe(name, {}, 12) for name in ("face_direction", "Hopper-v5", "Pendulum-v1")}
SEEDS = [7, 8, 9]
NEUTRAL = {"noise": 0, "delay": 0, "dropped": 0, "action_delay": 0}
SIGNALS = {"noise": "0..0.5", "delay": "0..2", "dropped": 0.3, "action_delay": "0..2"}
PHYSICS = {"friction": "0.5..1.5", "mass": "0.5..2", "push": 2}
BODIES = {"body": "0..3", "friction": "0.5..1.5"}


def tape(task, seeds=SEEDS, delay=0):
    """Observations, rewards and whether each environment's episode goes on, of the same actions."""
    random = np.random.default_rng(1)
    rows = random.uniform(task.action_low, task.action_high, (11, task.action_size))
    rows = np.concatenate((np.tile(task.rest, (delay, 1)), rows))
    envs = Environments(task, len(seeds), 1)
    steps = [(envs.reset(range(len(seeds)), seeds), np.zeros(len(seeds)))]
    for action in rows[:11]:
        steps.append(envs.step(np.tile(action, (len(seeds), 1)))[:2])
    envs.close()
    observations, rewards = zip(*steps, strict=True)
    return np.stack(observations), np.stack(rewards)


def assert_same(one, other, envs=slice(None)):
    for a, b in zip(one, other, strict=True):
        assert a[:, envs].tobytes() == b.tobytes()


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_domain_of_what_there_is_changes_no_bit(task):
    usual = {"friction": 1, "mass": 1, "push": 0} if task.id != "Pendulum-v1" else {}
    assert_same(tape(task), tape(with_domain(task, NEUTRAL | usual)))


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_what_is_late_or_lost(task):
    seen, rewards = tape(task)
    late, same = tape(with_domain(task, {"delay": 2}))
    np.testing.assert_array_equal(late[3:], seen[1:-2])
    np.testing.assert_array_equal(late[:3], seen[[0, 0, 0]])
    np.testing.assert_array_equal(same, rewards)
    held, _ = tape(with_domain(task, {"dropped": 1}))
    assert (held == seen[0]).all()
    commanded, _ = tape(with_domain(task, {"action_delay": 2}))
    np.testing.assert_array_equal(commanded, tape(task, delay=2)[0])
    some, _ = tape(with_domain(task, {"dropped": 0.5}))
    is_new = (some[1:] == seen[1:]).all(axis=2)
    assert (is_new | (some[1:] == some[:-1]).all(axis=2)).all()
    assert 0.2 < is_new.mean() < 0.8


@pytest.mark.parametrize(
    ("name", "given"),
    [(name, SIGNALS) for name in TASKS]
    + [("face_direction", PHYSICS), ("face_direction", BODIES), ("Hopper-v5", PHYSICS)],
)
def test_the_same_seed_gives_the_same_bytes_whatever_is_beside_it(name, given, monkeypatch):
    monkeypatch.setattr("jbrep.envs.domain._PUSHES", 0.3)
    task = with_domain(TASKS[name], given)
    whole = tape(task)
    assert not (whole[0] == tape(TASKS[name])[0]).all(axis=(0, 2)).any()
    assert_same(whole, tape(task, SEEDS[1:2]), [1])
    assert_same(whole, tape(task))  # in instances that have played other episodes


@pytest.mark.parametrize("given", [{"friction": 0.5}, {"mass": 2}, {"push": 2}], ids=str)
@pytest.mark.parametrize("name", ["face_direction", "Hopper-v5"])
def test_each_change_of_physics_is_felt(name, given, monkeypatch):
    monkeypatch.setattr("jbrep.envs.domain._PUSHES", 0.3)
    changed = tape(with_domain(TASKS[name], given))[0]
    assert not (changed == tape(TASKS[name])[0]).all(axis=(0, 2)).any()


def test_a_drawn_body_is_the_body_of_that_number():
    drawn = with_domain(TASKS["face_direction"], {"body": 3})
    assert_same(tape(drawn), tape(describe("face_direction", {"body": 3}, 12)))


@pytest.mark.parametrize("name", ["face_direction", "Pendulum-v1"])
def test_what_was_seen_last_stays_where_the_next_episode_begins(name):
    task = with_domain(TASKS[name], {"delay": 1})
    robots = AutoresetEnvironments(task, len(SEEDS), 1)
    robots.reset(SEEDS)
    steps = [robots.step(np.tile(task.action_high, (len(SEEDS), 1))) for _ in range(12)]
    assert steps[-1].ended.all()
    envs = Environments(task, len(SEEDS), 1)
    envs.reset(range(len(SEEDS)), SEEDS)
    alone = [envs.step(np.tile(task.action_high, (len(SEEDS), 1)))[0] for _ in range(12)]
    np.testing.assert_array_equal(steps[-1].final, alone[-1])
    assert (steps[-1].final != steps[-1].observation).any(axis=1).all()


def test_a_history_is_of_what_was_seen():
    task = with_domain(TASKS["face_direction"], SIGNALS)
    seen, _ = tape(task)
    both, _ = tape(with_view(task, history=2))
    size = task.size
    np.testing.assert_array_equal(both[..., :size], seen)
    np.testing.assert_array_equal(both[1:, :, size : 2 * size], seen[:-1])


def test_noise_is_a_share_of_what_features_spread():
    task = describe("Pendulum-v1", episode_steps=200, domain={"noise": 0.1})
    (cosine, _, speed) = task.domain.spread
    assert 0.5 < cosine < 1
    assert 1 < speed < 8
    still, noise = np.zeros((20, 1)), []
    envs = [Environments(each, 20, 1) for each in (task, with_domain(task, {}))]
    for each in envs:
        each.reset(range(20), range(20))
    while envs[0].num_active:
        noisy, plain = (each.step(still).observation for each in envs)
        noise.append(noisy - plain)
    noise = np.stack(noise)
    np.testing.assert_allclose(noise.std(axis=(0, 1)) / task.domain.spread, 0.1, rtol=0.05)
    now, before = noise[1:].reshape(-1, 3), noise[:-1].reshape(-1, 3)
    assert np.abs(np.corrcoef(now.T, before.T)[:3, 3:]).max() < 0.07


def test_an_angle_stays_in_its_turn():
    task = with_domain(TASKS["face_direction"], {"noise": 1})
    places = [i for i, each in enumerate(task.features) if each.is_full_turn]
    seen = tape(task, range(50))[0][..., places]
    assert np.abs(seen).max() <= np.pi
    assert (np.abs(seen) > 3).any()


def test_an_episode_draws_each_number_from_its_range_and_apart_from_the_others():
    domain = Domain(**read_ranges({"delay": "1..3", "friction": [0.5, 1.5], "body": "4..5"}))
    drawn = [domain.draw(seed) for seed in range(300)]
    for name, values in (("delay", {1, 2, 3}), ("body", {4, 5}), ("mass", {1.0})):
        assert {getattr(each, name) for each in drawn} == values
    friction = np.array([each.friction for each in drawn])
    np.testing.assert_allclose(np.quantile(friction, (0, 0.5, 1)), (0.5, 1, 1.5), atol=0.1)
    alone = Domain(friction=(0.5, 1.5))
    assert [alone.draw(seed).friction for seed in range(300)] == friction.tolist()
    assert alone.draw(0).body is None
    assert str(domain) == "delay=1..3,friction=0.5..1.5,body=4..5"


def test_pushes_come_in_a_hundredth_of_all_steps_from_all_sides():
    draws = Draws(50, 0)
    draws.begin(np.arange(50), np.arange(50))
    pushes = []
    for _ in range(1000):
        draws.move()
        pushes.append(draws.pushes(np.full(50, 0.2)))
    pushes = np.concatenate(pushes)
    pushes = pushes[pushes.any(axis=1)]
    assert 400 < len(pushes) < 600
    np.testing.assert_allclose(np.linalg.norm(pushes[:, :2], axis=1), 0.2)
    assert np.abs(pushes.mean(axis=0)).max() < 0.03


LEGGED = """<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size=".1" mass="2"/>
<body pos=".2 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
</body></body><geom type="plane" size="1 1 1" friction=".7"/></worldbody></mujoco>"""


def test_a_push_gives_the_whole_robot_its_velocity():
    model = mujoco.MjModel.from_xml_string(LEGGED)
    data, push = mujoco.MjData(model), np.array([0.3, -0.1, 0])
    qpos = data.qpos.copy()
    qpos[3:] = 0.5, 0.5, -0.5, 0.5, 0.7
    added = velocity_after(model, qpos, push, mujoco.MjData(model))
    data.qpos, data.qvel = qpos, added
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    np.testing.assert_allclose(data.subtree_linvel[1], push, atol=1e-12)
    assert np.abs(added[-1]) > 0.01  # the leg swings


def test_factors_are_of_the_model_s_friction_and_masses():
    usual, varied = (mujoco.MjModel.from_xml_string(LEGGED) for _ in range(2))
    data = mujoco.MjData(usual)
    put_factors(varied, usual, 0.5, 3, data)
    np.testing.assert_allclose(varied.body_subtreemass, 3 * usual.body_subtreemass)
    np.testing.assert_allclose(varied.dof_invweight0, usual.dof_invweight0 / 3)
    np.testing.assert_allclose(varied.geom_friction, usual.geom_friction / 2)
    put_factors(varied, usual, 1, 1, data)
    for name in ("body_mass", "body_inertia", "dof_invweight0", "geom_friction"):
        assert getattr(varied, name).tobytes() == getattr(usual, name).tobytes()


class Loaded(gymnasium.Env):
    """A robot that draws its own mass in each episode, which is its reward."""

    action_space = observation_space = gymnasium.spaces.Box(-1, 1)

    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(LEGGED)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.model.body_mass[1] = self.np_random.uniform(0.5, 3)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), self.model.body_mass[1], False, False, {}


def test_what_an_environment_draws_itself_stays_drawn(monkeypatch):
    """Two environments, of which one plays a second episode; a factor is on top of it."""
    spec = EnvSpec("Loaded-v0", Loaded, max_episode_steps=9)
    monkeypatch.setitem(gymnasium.registry, "Loaded-v0", spec)

    def masses(**domain):
        envs, still = Environments(describe("Loaded-v0", domain=domain), 2), np.zeros((2, 1))
        envs.reset([0, 1], [1, 2])
        first = envs.step(still).reward
        envs.reset([0], [3])
        legs = [env.unwrapped.model.body_mass[2] for env in envs.instances]
        second = envs.step(still).reward
        envs.close()
        return np.array([*first, *second, *legs])

    drawn = masses()
    assert len({*drawn}) == 4  # of three episodes, and of the legs
    np.testing.assert_array_equal(masses(push=0.5), drawn)
    np.testing.assert_array_equal(masses(friction=0.5), drawn)
    np.testing.assert_allclose(masses(mass=2), 2 * drawn)


@pytest.mark.parametrize(
    "given",
    [
        *({"wind": 1}, {"delay": "soon"}, {"delay": 0.5}, {"delay": "3..1"}, {"dropped": 2}),
        {"friction": 2},  # the pendulum has no model
    ],
    ids=str,
)
def test_what_a_domain_refuses(given):
    assert next(iter(given)) in refused(with_domain, TASKS["Pendulum-v1"], given)


def test_data_sets_are_of_one_domain():
    task = with_domain(TASKS["face_direction"], {"delay": 1})
    assert "delay=1" in refused(lambda: DataSettings(task=task, steps=10))


def test_the_command_shows_what_a_policy_keeps(tmp_path):
    played = ("evaluate-policy", "heuristic", "--task", "move_in_direction", "--episodes", 2)
    played += ("--episode-steps", 30)
    file = tmp_path / "table.json"
    told = jbrep(*played, "--perturb", "--out", file)
    assert told.exit_code == 0, told.output
    rows = json.loads(file.read_text())["rows"]
    assert [row["name"] for row in rows][-2:] == ["push=0.1", "push=0.3"]
    assert rows[0]["returns"] == json.loads(jbrep(*played, "--json").output)["returns"]
    usual = np.mean(rows[0]["returns"])
    shares = [row["share"][0] for row in rows]
    assert shares == pytest.approx([np.mean(row["returns"]) / usual for row in rows])
    assert len(set(shares)) > 3
    one = json.loads(jbrep(*played, "--perturb", "delay=2", "--json").output)["rows"]
    assert one == [rows[0], next(row for row in rows if row["name"] == "delay=2")]
    assert "--perturb soon" in mistake(*played, "--perturb", "soon")


DRAWN = {**BODIES, "delay": "0..2", "noise": "0..0.2", "push": "0..0.5"}
SMALL = {"num_envs": 2, "net_arch": [8], "learning_starts": 20, "batch_size": 4}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run whose episodes draw, and the same, stopped within an episode."""
    folder = tmp_path_factory.mktemp("runs")
    steps = {"steps": 200, "evaluation_episodes": 2, "final_episodes": 2}
    task = with_domain(TASKS["face_direction"].replace(max_episode_steps=30), DRAWN)
    run = Run.of(task, "sac", "modern", SMALL, **steps)
    train(run, folder / "whole")
    with pytest.raises(StoppedError):
        train(run, folder / "stopped", stopping(90))
    train(run, folder / "stopped")
    return folder


def test_a_run_that_was_stopped_draws_on(runs):
    assert_same_files(runs / "stopped", runs / "whole", EPISODES, EVALUATIONS)


def test_whoever_reads_a_run_knows_its_domain(runs):
    settings = read_run(runs / "whole").settings
    assert str(settings.environment.domain) == (
        "noise=0..0.2,delay=0..2,friction=0.5..1.5,push=0..0.5,body=0..3"
    )
    player = find_player(str(runs / "whole"))
    evaluated = last_returns(read_evaluations(runs / "whole"))
    np.testing.assert_allclose(player.returns(2), evaluated, atol=1e-3)
    plain = TASKS["face_direction"].replace(max_episode_steps=30)
    assert not np.allclose(find_player(str(runs / "whole"), plain).returns(2), evaluated, rtol=0.01)
    rows, _ = domains_of(player.task, ["delay=1"])
    assert [*rows] == ["undisturbed", "as in training", "delay=1"]
    assert rows["as in training"] == settings.environment.domain
