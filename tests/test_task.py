"""Tasks: what is found out of an environment, what is refused, and what a stranger may write."""

import json
from functools import partial

import environments
import gymnasium
import numpy as np
import pytest
from command import jbrep, mistake, refused
from gymnasium.envs.registration import EnvSpec

from jbrep import api
from jbrep.cli.generator import parse_pairs
from jbrep.dataset.schema import episode_seed
from jbrep.envs import Environments, Feature, Task, describe
from jbrep.envs.names import Known, import_modules, name_given, spec_of
from jbrep.envs.recording import outcome
from jbrep.envs.task import check_same
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import TASKS, get_task
from jbrep.records.record import from_plain, to_plain

SLEDGE = "Sledges/Sledge-v0"
PLAIN = Task(
    id="Arms/Reach-v0",
    name="Arms/Reach-v0",
    features=(Feature("x", "m", -1, 1, True, "place"), Feature("y", "m", group="place")),
    action_low=(-1.0, 0.0),
    action_high=(1.0, 2.5),
    max_episode_steps=50,
    arguments={"gain": 2, "path": ["a", None]},
    reward_low=-2.0,
    state={"angle": 2},
    constants={"goal": 3},
)


@pytest.mark.parametrize("name", TASKS)
def test_the_jitterbug_s_tasks_are_described_without_making_them(name, monkeypatch):
    monkeypatch.setattr(gymnasium, "make", None)
    task = describe(name, episode_steps=7)
    assert task == get_task(name).describe({}, 7)
    assert task == describe(task.id).replace(max_episode_steps=7, solved_return=0.9 * 7)
    assert (task.name, task.slug, task.timestep) == (name, name, 0.01)
    assert gymnasium.spec(task.id).max_episode_steps == describe(name).max_episode_steps
    assert gymnasium.spec(task.id).reward_threshold == describe(name).solved_return


def test_an_environment_of_gymnasium():
    hopper = describe("Hopper-v5")
    assert (hopper.name, hopper.slug, hopper.size) == ("Hopper-v5", "Hopper-v5", 11)
    assert hopper.feature_names[:3] == ("rootz", "rooty", "thigh_joint")  # after its joints
    assert hopper.feature_names[-1] == "foot_joint_velocity"
    assert str(hopper).startswith("Hopper-v5\n")
    assert (hopper.action_low, hopper.action_high) == ((-1.0,) * 3, (1.0,) * 3)
    assert (hopper.max_episode_steps, hopper.timestep) == (1000, 0.008)
    assert (hopper.terminates, hopper.reproducible, hopper.seed_bits) == (True, True, 63)
    pendulum = describe("Pendulum-v1")
    assert [(f.low, f.high) for f in pendulum.features] == [(-1, 1), (-1, 1), (-8, 8)]
    assert (pendulum.action_low, pendulum.action_high) == ((-2.0,), (2.0,))
    assert (pendulum.terminates, pendulum.timestep) == (None, 0.05)


def test_one_of_the_dm_control_suite():
    """It keeps its time limit for itself, and takes seeds of 32 bits only."""
    pytest.importorskip("shimmy")
    task = describe("dm_control/cartpole-swingup-v0")
    assert gymnasium.spec(task.id).max_episode_steps is None
    assert (task.max_episode_steps, task.seed_bits) == (1000, 31)
    assert task.slug == "dm_control-cartpole-swingup-v0"
    assert task.groups == {"position": slice(0, 3), "velocity": slice(3, 5)}
    assert task.feature_names[2:4] == ("position_2", "velocity_0")
    envs = Environments(task.replace(max_episode_steps=3), 1)
    envs.reset([0], [episode_seed(task, 2046, 0)])
    for root, number in ((2047, 0), (0, 1 << 20)):
        with pytest.raises(InputError, match="seeds of 31 bits"):
            episode_seed(task, root, number)
    few = {episode_seed(task, root, n) for root in (0, 1, 2046) for n in (0, 1, 2**20 - 1)}
    assert len(few) == 9
    assert max(few) < 2**31


def test_a_dictionary_s_keys_name_the_features_in_the_order_of_flattening():
    task = describe("Sledges/Nested-v0")
    assert task.feature_names == (
        *("odd_key_0", "odd_key_1", "signs.part0_0", "signs.part0_1"),
        *("signs.part1_0", "signs.part1_1", "signs.part1_2", "sledge.place", "sledge.speed"),
    )
    envs = Environments(task, 1)
    envs.reset([0], [4])
    environment = gymnasium.make(task.id)
    observation, _ = environment.reset(seed=4)
    flat = gymnasium.spaces.flatten(environment.observation_space, observation)
    np.testing.assert_array_equal(envs.observation[0], flat)


def test_an_environment_may_describe_itself():
    task = describe("Sledges/Told-v0", {"rail": 2.0}, 9)
    expected = environments.Told.describe({"rail": 2.0}, 9)
    assert task == expected.replace(files=task.files)
    assert [*task.files] == ["module environments"]
    assert task.arrays == {"heat": 1, "colour": 3}


@pytest.mark.parametrize("name", ["Moody", "Worn"])
def test_an_environment_that_is_not_reproducible_is_called_so(name):
    """One that draws on its own, and one whose used instance differs from a fresh one."""
    assert not describe(f"Sledges/{name}-v0").reproducible
    assert "no: with the same seed and actions" in jbrep("env", f"Sledges/{name}-v0").output


def test_arguments_reach_the_environment():
    def returns(name, **arguments):
        task = describe(name, arguments, 15)
        assert task.arguments == arguments
        envs = Environments(task, 2)
        middle = np.tile(np.add(task.action_low, task.action_high) / 2, (2, 1))
        return outcome(envs, lambda observation: middle).returns

    assert (returns("Pendulum-v1") == returns("Pendulum-v1", g=10.0)).all()
    assert (returns("Pendulum-v1", g=1.6) != returns("Pendulum-v1")).all()
    assert (returns(SLEDGE, wind=0.5) != returns(SLEDGE)).all()


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("CartPole-v1", {}, "Discrete"),
        ("Sledges/Free-v0", {}, "has actions without bounds"),
        ("Sledges/Filmed-v0", {}, "only features are possible"),
        ("Sledges/Endless-v0", {}, "episode_steps"),
        ("face_directoin", {}, "did you mean face_direction"),
        ("environments:Sledges/Sledge-v0", {}, "names a module"),
        ("Pendulum-v1", {"weight": 3}, "weight"),
        ("Pendulum-v1", {"g": float("nan")}, "finite"),
        ("face_direction", {"scaled": True}, "has no argument scaled"),
    ],
)
def test_what_can_t_be_a_task_is_said_in_one_line(name, arguments, message):
    with pytest.raises(InputError, match=message) as refusal:
        describe(name, arguments)
    assert "\n" not in str(refusal.value)


class Sledging(environments.Sledge):
    """A sledge that ends, and tells, as its arguments say.

    Args:
        lasts: steps after which episodes are truncated, by their seeds.
        lost: where along the rail an episode is truncated.
        fails: in the step with this number.
        numbers: of an observation.
        shape: of an action.
    """

    dt = np.float32(0.25)

    def __init__(self, lasts=(99999,), lost=1e9, fails=None, numbers=2, shape=(1,)):
        super().__init__(rail=np.inf)
        self.lasts, self.lost, self.fails, self.numbers = lasts, lost, fails, numbers
        self.action_space = gymnasium.spaces.Box(-0.1, 0.1, shape)

    def reset(self, *, seed=None, options=None):
        given = super().reset(seed=seed)
        self.length = self.lasts[seed % len(self.lasts)]
        return given

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        assert self.steps != self.fails, "the rail broke"
        self.state += 0.1 * action.sum()
        is_over = self.steps == self.length or bool(abs(self.state[0]) > self.lost)
        return self.observe(), 0.0, False, is_over, {}

    def observe(self):
        return np.resize(self.state, self.numbers)


@pytest.fixture
def sledging(monkeypatch):
    """Describes one that is registered without a time limit."""
    monkeypatch.setitem(gymnasium.registry, "Sledging-v0", EnvSpec("Sledging-v0", Sledging))
    return lambda limit=None, **arguments: describe("Sledging-v0", arguments, limit)


def test_a_time_limit_is_the_same_in_each_episode(sledging):
    task = sledging(lasts=[350])
    assert (task.max_episode_steps, task.timestep) == (350, 0.25)
    for other in ({"lasts": [20, 150]}, {"lasts": [350, 250]}, {"lost": 0.25}):
        assert "`episode_steps`" in refused(partial(sledging, **other))
    assert "AssertionError: the rail broke" in refused(partial(sledging, fails=300))
    assert sledging(250, fails=300).max_episode_steps == 250
    assert "failed when it was tried: AssertionError" in refused(partial(sledging, fails=30))


def test_an_action_may_be_one_number_alone(sledging):
    task = sledging(9, shape=())
    assert task.action_size == 1
    envs = Environments(task, 1)
    envs.reset([0], [0])
    assert envs.step([[0.1]]).observation.any()


def test_observations_must_fit_their_space(sledging):
    said = "failed when it was tried: ValueError: it gave an observation of 3 numbers instead of 2"
    assert said in refused(partial(sledging, 9, numbers=3))


def test_modules_are_imported_for_a_command_line_only(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    (tmp_path / "sledges_too.py").write_text("import environments")
    (tmp_path / "broken_package.py").write_text("1 / 0")
    assert name_given(SLEDGE) == SLEDGE
    assert Known.of([]).modules == ()
    assert name_given(f"sledges_too:{SLEDGE}") == SLEDGE
    import_modules(["sledges_too"])
    assert Known.of([]).modules == ("sledges_too",)
    for module, reason in (("none", "No module named 'none'"), ("broken_package", "division by")):
        with pytest.raises(InputError, match=f"can't import {module}: .*{reason}"):
            name_given(f"{module}:Some-v0")


def test_a_task_as_json_is_read_again():
    for task in (PLAIN, describe("move_to_pose"), describe("Hopper-v5"), describe(SLEDGE)):
        text = json.dumps(to_plain(task), allow_nan=False)
        assert from_plain(json.loads(text), Task) == task
        assert to_plain(from_plain(json.loads(text), Task)) == to_plain(task)


def test_what_was_made_for_another_task_is_refused():
    check_same(PLAIN, PLAIN.replace(arguments={"gain": 3}), "the encoder")
    with pytest.raises(InputError, match="the encoder was made for Arms/Fetch-v0, not for Arms/R"):
        check_same(PLAIN, PLAIN.replace(id="Arms/Fetch-v0", name="Arms/Fetch-v0"), "the encoder")
    others = (Feature("x"), Feature("z"))
    with pytest.raises(
        InputError, match=r"was made for other features of Arms/Reach-v0.*: give the same `hide`"
    ):
        check_same(PLAIN, PLAIN.replace(features=others), "the encoder")


def test_scaling_is_by_the_ranges_that_are_known():
    task = PLAIN.replace(features=(Feature("x", low=0, high=4), Feature("y"), Feature("z", low=1)))
    values = np.array([[4.0, 7.0, 3.0], [0.0, -7.0, 0.0]])
    np.testing.assert_array_equal(task.scale(values), [[1, 7, 3], [-1, -7, 0]])
    np.testing.assert_array_equal(task.unscale(task.scale(values)), values)
    assert PLAIN.return_floor == -100
    np.testing.assert_array_equal(PLAIN.split(values[:, :2])["place"], values[:, :2])


TABLE = """
timestep = 0.1
reward_high = 0
solved_return = -5.0

[[features]]
name = "place"
unit = "m"
low = -1
high = 1.5
group = "sledge"

[[features]]
group = "sledge"
"""


def test_a_file_says_what_features_are(tmp_path):
    path = tmp_path / "features.toml"
    path.write_text(TABLE)
    task = describe(SLEDGE, features=path)
    assert task.features[0] == Feature("place", "m", -1, 1.5, group="sledge")
    assert task.features[1] == Feature("obs_1", group="sledge")
    assert (task.timestep, task.reward_high, task.solved_return) == (0.1, 0, -5)
    assert task.groups == {"sledge": slice(0, 2)}
    path.write_text("timestep = 2")
    assert describe(SLEDGE, features=path) == describe(SLEDGE).replace(timestep=2.0)
    told = jbrep("env", SLEDGE, "--features", path, "--env", "wind=0.5", "--json").output
    assert from_plain(json.loads(told), Task).arguments == {"wind": 0.5}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[features]]\nname = 'x'", "each of the 2 features"),
        ("[[features]]\nnames = 'x'\n[[features]]", "features[0].names"),
        ("speed = 1", "speed"),
        ("[[features]]\nname = 'obs_1'\n[[features]]", "different names"),
        ("timestep = -1", "timestep"),
        ("timestep = ", "TOML"),
    ],
)
def test_a_mistaken_file_of_features_is_refused_in_one_line(text, message, tmp_path):
    path = tmp_path / "features.toml"
    path.write_bytes(text.encode("latin-1"))
    told = refused(lambda: describe(SLEDGE, features=path))
    assert str(path) in told
    assert message in told


def test_arguments_are_shown_as_the_command_line_takes_them():
    texts = {"mode": "fast, or not", "number": "7", "nothing": "null", "empty": "", "lines": "a\nb"}
    arguments = {**texts, "wind": 0.5, "still": True, "path": ["a", None], "sizes": {"x": 1}}
    shown = PLAIN.replace(arguments=arguments).given_arguments
    assert shown[:3] == ["mode=fast, or not", 'number="7"', 'nothing="null"']
    assert not [each for each in shown if "\n" in each]
    assert parse_pairs(shown) == arguments


def test_bounds_are_given_to_actions_that_have_none_and_kept_within_those_they_have():
    free = describe("Sledges/Free-v0", action_bounds="-0.5..0.25")
    assert (free.action_low, free.action_high) == ((-0.5,) * 3, (0.25,) * 3)
    assert from_plain(to_plain(free), Task) == free != describe(free.id, action_bounds=(-1, 1))
    sledge = describe(SLEDGE, action_bounds=[(-1, 0), (1, 2), (0, 0.5)])
    assert (sledge.action_low, sledge.action_high) == ((-1, 1, 0), (0, 2, 0.5))
    face = describe("face_direction", action_bounds=(-0.5, 0.5))  # which describes itself
    assert (face.action_low, face.action_high) == ((-0.5,), (0.5,))
    for wrong in ("-2..2", "0.5..-0.5", "-1..1,-1..1", "1", "a..b"):
        assert "action_bounds" in refused(partial(describe, SLEDGE, action_bounds=wrong))
    told = mistake("env", "Sledges/Free-v0")
    assert "give --action-bounds, such as -1..1" in told
    assert jbrep("env", "Sledges/Free-v0", "--action-bounds", "-1..1").exit_code == 0


def test_a_class_or_an_instance_is_a_task(monkeypatch, tmp_path):
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    told = describe(environments.Sledge, episode_steps=30)
    assert told.id == "environments/Sledge"
    assert Known.of([]).modules == ("environments",)  # for the processes that collect
    monkeypatch.delitem(gymnasium.registry, told.id)
    assert describe("environments/Sledge", episode_steps=30) == told
    monkeypatch.delitem(gymnasium.registry, told.id)
    monkeypatch.setattr("jbrep.envs.names._imported", [])
    assert "environments defines it" in refused(spec_of, told)
    assert name_given("environments:Sledge") == told.id

    made = gymnasium.make("Pendulum-v1", g=3.0)
    assert describe(made) == describe("Pendulum-v1", {"g": 3.0})
    own = environments.Sledge(wind=0.5)
    task = describe(own, episode_steps=30)
    assert task.id == "instance/Sledge"
    data = api.collect(task, tmp_path / "data", 60)
    assert len(data) >= 60
    agent = api.train(task, tmp_path / "run", algorithm="a2c", steps=32, evaluation_episodes=1)
    assert agent.record.settings.one_robot
    assert "it must be a name, a Task or an environment" in refused(describe, 7)


def test_features_are_named_after_the_joints_that_they_are():
    assert describe("Ant-v5").feature_names[:3] == ("root_z", "root_qw", "root_qx")
    assert describe("Reacher-v5").feature_names[3:6] == ("obs_3", "target_x", "target_y")
