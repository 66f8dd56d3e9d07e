"""Whether codes serve a controller: on a made-up robot of which all is known."""

from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.metrics import r2_score
from tensors import torch_threads
from wide import make_feature, make_task

from jbrep.coordinates import wrapped
from jbrep.dataset import Column, Dataset, ScaledDataset
from jbrep.encoders import Encoder, Layer
from jbrep.encoders.header import EncoderHeader
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.evaluation import control, prediction, regression
from jbrep.evaluation.control import GoodPolicy, PlayedEpisode, lost, needs
from jbrep.evaluation.diagnosis import diagnose, networks
from jbrep.evaluation.evaluation import Judged, Lost, Score
from jbrep.evaluation.held_out import HeldOut, explained
from jbrep.evaluation.readout import probes
from jbrep.evaluation.regression import Networks, Problem, beside, fit
from jbrep.evaluation.table import headline
from jbrep.play.sources import find_good_policy
from jbrep.reporting.evaluation import judge

NAMES = ("place", "speed", "load", "idle")
STEPS, EPISODES = 60, 200


class Cart:
    """A cart that is pushed and pulled back; each action moves it at once.

    `load` turns the action's direction, so that what comes next can't be said without it; `idle`
    wanders by itself, and nothing depends on it. The reward is for being at 0.
    """

    split = Dataset.split
    fit_scaler = Dataset.fit_scaler
    folder = "cart"

    def __init__(self):
        features = [make_feature(name) for name in NAMES]
        task = make_task(features, "Cart-v0")
        self.task = task.replace(action_low=(-1.0,), action_high=(1.0,))
        self.episodes = {"length": np.full(EPISODES, STEPS), "seed": np.arange(EPISODES)}
        policy = SimpleNamespace(policy={"kind": "uniform"}, seed=0, unrewarded=False)
        self.manifest, self.fingerprint = SimpleNamespace(settings=policy), "cart"
        random = np.random.default_rng(0)
        actions = random.uniform(-1, 1, (EPISODES, STEPS, 1)).astype(np.float32)
        seen, reward = self.play(lambda step, seen: actions[:, step, 0], random)
        self.arrays = {
            "observation": seen[:, :-1].reshape(-1, 4),
            "action": actions.reshape(-1, 1),
            "reward": reward.ravel(),
        }

    @staticmethod
    def play(act, random):
        place, speed, idle = random.uniform(-1, 1, (3, EPISODES))
        load = random.choice((-1.0, 1.0), EPISODES)
        observations, rewards = [], []
        for step in range(STEPS + 1):
            observations.append(np.stack((place, speed, load, idle), 1).astype(np.float32))
            push = act(min(step, STEPS - 1), observations[-1])
            speed = 0.9 * speed - 0.1 * place + 0.3 * load * push
            place = place + 0.3 * speed
            idle = 0.95 * idle + 0.1 * random.normal(size=EPISODES)
            load = np.where(random.uniform(size=EPISODES) < 0.1, -load, load)
            rewards.append(np.exp(-np.square(place)).astype(np.float32))
        return np.stack(observations, 1), np.stack(rewards, 1)[:, :STEPS]

    def __getitem__(self, name):
        values = self.arrays[name]
        return Column(lambda shard: values, [len(values)], values.dtype, values.shape[1:])


def controller(seen):
    """Push toward 0: what it does takes place, speed and load."""
    drive = np.clip(-seen[:, 2] * (seen[:, 0] + 0.5 * seen[:, 1]), -1, 1)
    return drive[:, None]


@pytest.fixture(scope="module", autouse=True)
def learning():
    """Steps and horizons enough for the cart."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prediction, "HORIZONS", (1, 5, 10))
        patch.setattr(regression, "_STEPS", 400)
        patch.setattr(control, "_SHARE", 1.0)
        yield


@pytest.fixture(scope="module")
def held_out():
    return HeldOut(ScaledDataset(Cart()))


@pytest.fixture(scope="module")
def policy():
    seen, reward = Cart.play(lambda step, seen: controller(seen)[:, 0], np.random.default_rng(1))
    played = [PlayedEpisode(o, r, True) for o, r in zip(seen, reward, strict=True)]
    return GoodPolicy("mine", controller, played)


def code(data, *kept):
    """A code of these features alone."""
    weight = np.eye(4, dtype=np.float32)[[NAMES.index(name) for name in kept]]
    metrics = {"spectrum": [3.0, 1.0]}
    header = EncoderHeader(kind="subset", name="subset", environment=data.task, metrics=metrics)
    there, back = (
        (Layer(each, np.zeros(len(each), np.float32), "linear"),)
        for each in (weight, weight.T.copy())
    )
    return Encoder(header, data.scaler, there, back)


@pytest.fixture(scope="module")
def evaluation(held_out, policy):
    data = held_out.data
    encoders = {
        f"without {name}": code(data, *(n for n in NAMES if n != name)) for name in ("load", "idle")
    }
    encoders["noise"] = lambda seen: np.random.default_rng(0).normal(size=(1, 2)) + 0 * seen[:, :2]
    return diagnose(encoders, data, policy)


def test_a_code_loses_the_feature_that_it_drops_by_name(evaluation):
    lost_by = {n: [e.name for e in d.loses] for n, d in evaluation.encoders.items()}
    assert lost_by["full"] == lost_by["without idle"] == []
    assert lost_by["without load"] == ["load"]
    assert set(lost_by["noise"]) == set(NAMES[:3])
    assert evaluation.needs["idle"] < 0.1


def test_what_is_dropped_shows_where_it_matters(evaluation):
    everything = {n: headline(d) for n, d in evaluation.encoders.items()}
    full = everything.pop("full")
    for scalars in everything.values():
        for name in ("forward", "reward", "value", "action"):
            assert scalars[name] < full[name] + 0.03, name
    for name in ("reward", "value", "action"):
        assert everything["without idle"][name] > full[name] - 0.03
        assert abs(everything["noise"][name]) < 0.1
    assert everything["without load"]["action"] < 0.1 < 0.9 < full["action"]
    changes = evaluation.encoders["without idle"].prediction["10"].features
    assert changes["idle"][0] < 0.1 < changes["speed"][0]
    assert "times_pca" not in full
    value, low, high = evaluation.encoders["full"].scores["value"]
    assert low < value < high


def test_the_smallest_code_without_a_loss_is_to_take_and_else_the_smallest(evaluation):
    good = evaluation.encoders["without idle"]
    lost = evaluation.encoders["without load"].loses
    codes = {
        "full": evaluation.encoders["full"],
        "large": good.replace(latent=3, loses=()),
        "larger": good.replace(latent=4, loses=()),
        "small": good.replace(latent=2, loses=lost),
    }
    judged = judge(evaluation.replace(encoders=codes))
    assert (judged.recommended, {*judged.enough}) == ("large", {"large", "larger", "small"})
    codes |= {label: codes[label].replace(loses=lost) for label in ("large", "larger")}
    assert judge(evaluation.replace(encoders=codes)).recommended == "small"


def test_nothing_is_said_where_it_cannot_be(evaluation):
    codes = {name: evaluation.encoders[name] for name in ("full", "without load", "noise")}
    judged = judge(evaluation.replace(encoders=codes))
    assert (judged.recommended, judged.nearest) == (None, "without load")
    full, unknown = codes["full"], Score(None, None, None)
    blind = {
        steps: ahead.replace(rewarded=unknown, reward=unknown, mean=unknown)
        for steps, ahead in full.prediction.items()
    }
    nothing = evaluation.replace(encoders=codes | {"full": full.replace(prediction=blind)})
    assert judge(nothing).unknown
    assert evaluation.encoders["without load"].method == {"spectrum": [3.0, 1.0]}


def test_without_a_policy_its_value_and_action_are_none(held_out, policy, monkeypatch):
    monkeypatch.setattr(regression, "_STEPS", 2)
    result = diagnose({"it": code(held_out.data, "place")}, held_out.data)
    assert result.policy is None
    assert not any({"value", "action"} & {*each.scores} for each in result.encoders.values())
    assert find_good_policy(None, held_out.data.task) is None
    assert find_good_policy(None, describe("face_direction"), own_rewards=True) is None
    cut = [PlayedEpisode(np.zeros((101, 4), np.float32), np.ones(100), False)] * 5
    short = GoodPolicy("short", controller, cut)
    assert set(networks(code(held_out.data, "place"), held_out, short).of_policy) == {"action"}
    with pytest.raises(InputError, match="policy uniform doesn't act on what it observes"):
        find_good_policy("uniform", held_out.data.task)


def test_an_episodes_values_are_judged_by_what_was_fitted_to_others(held_out, policy):
    """An oracle of the episodes that it was fitted to, which knows nothing of the others."""
    seen, it = policy.states, code(held_out.data, "place")
    told = control.problems(it, held_out, policy)
    assert [name for name in told if name != "action"] == ["value 0", "value 1", "value 2"]
    assert np.sum([*seen.folds.values()], axis=0).tolist() == [1] * len(seen.value)

    def oracle(problem):
        known = {tuple(row): value for row, value in zip(*problem[:2], strict=True)}
        return lambda values: np.array([known.get(tuple(row), [1e3]) for row in values])

    known = {name: oracle(problem) for name, problem in told.items()}
    judged = Judged(it, held_out, policy, Networks({}, None, known), None)
    assert control.value(judged).value < 0


def test_actions_after_the_horizon_do_not_enter(held_out, monkeypatch):
    monkeypatch.setattr(regression, "_STEPS", 20)
    steps, inputs = prediction.following(held_out, "train", 5), code(held_out.data, "speed")
    assert steps.inputs(inputs).shape == (len(steps.rows), 1 + 5)
    rows = held_out.data.dataset["action"]
    np.testing.assert_array_equal(steps.action[7], rows[steps.rows[7] : steps.rows[7] + 5].ravel())
    before = prediction.prediction(inputs, held_out, networks(inputs, held_out).forward)
    poisoned = ScaledDataset(Cart())
    last = np.arange(len(rows)) % STEPS >= STEPS - 1  # no window of 1 begins there
    poisoned.dataset.arrays["action"][last] = np.nan
    again = HeldOut(poisoned)
    after = prediction.prediction(inputs, again, networks(inputs, again).forward)
    assert after["1"] == before["1"]


def test_what_follows_is_of_the_same_episode(held_out):
    dataset = held_out.data.dataset
    steps = prediction.following(held_out, "test", 20)
    assert (steps.rows % STEPS).max() == STEPS - 21
    assert set(steps.rows // STEPS) == set(held_out.numbers)
    observation, reward = dataset["observation"], dataset["reward"]
    row = steps.rows[11]
    change = observation[row + 20] - observation[row]
    expected = [*change, reward[row : row + 20].mean()]
    np.testing.assert_allclose(steps.wanted[11], expected, atol=1e-6)
    short = ScaledDataset(Cart())
    short.dataset.episodes = {"length": np.full(1200, 10), "seed": np.arange(1200)}
    short.train, short.test = short.dataset.split()
    assert prediction.usual_horizons(short) == [1, 5]


def test_r_squared_and_interval_by_episode(held_out):
    rows = held_out.data.test
    true = held_out.data.dataset["observation"][rows]
    predicted = true + np.random.default_rng(0).normal(size=true.shape) * [0.1, 1, 2, 0]
    *parts, mean = explained(predicted, true, rows, held_out.sums, [1, 1, 2], [np.array([1, 1, 0])])
    expected = [r2_score(true[:, i].astype(float), predicted[:, i]) for i in (0, 1)]
    assert [part[0] for part in parts[:2]] == pytest.approx(expected)
    assert mean[0] == pytest.approx(np.mean(expected))
    by_row = (true - predicted)[:, 1].std() ** 2 / true[:, 1].var() / np.sqrt(len(rows))
    assert parts[1][2] - parts[1][1] > 3 * by_row


def test_regression_finds_what_is_not_linear_and_repeats_to_the_last_bit(monkeypatch):
    monkeypatch.setattr(regression, "_STEPS", 600)
    random = np.random.default_rng(0)
    values = random.normal(size=(20_000, 6)) * [1, 1, 1, 1e4, 1, 0] + [0, 0, 0, 0, 1e6, 3]
    sine = np.sin(2 * values[:, 0]) * values[:, 1]
    wanted = np.stack((sine, 1e5 + values[:, 2], 0 * values[:, 5]), 1)
    problem = Problem(values[:15_000], wanted[:15_000])
    twice = [each(values[15_000:]) for each in fit([problem, problem])]
    assert r2_score(wanted[15_000:, 0], twice[0][:, 0]) > 0.95
    assert r2_score(wanted[15_000:, 1], twice[0][:, 1]) > 0.95
    assert (twice[0][:, 2] == 0).all()
    with torch_threads(2):
        again = [each(values[15_000:]) for each in fit([problem, problem])]
    assert again[0].tobytes() == twice[0].tobytes()
    assert again[1].tobytes() == twice[1].tobytes() == twice[0].tobytes()  # as if each were alone


def test_angles_change_by_all_that_they_turn():
    spin = make_feature("spin", "rad", -np.pi, np.pi, True, "angle")
    task = make_task([spin, make_feature("place")], "Top-v0")
    turned = np.array([0, 1, 2.5, 4, 7, 6, 4])
    rows = np.stack((wrapped(turned + 3), turned), axis=1).astype(np.float32)
    found = prediction.changes(task, rows, np.array([0, 2]), 4)
    assert found == pytest.approx(np.array([[7, 7], [1.5, 1.5]]), abs=1e-5)


def test_a_rare_reward_is_learnt_beside_many_features(monkeypatch):
    random = np.random.default_rng(0)
    seen = random.normal(size=(20_000, 6)).astype(np.float32)
    near = np.clip(1 - 3 * np.hypot(seen[:, 0] - 1.5, seen[:, 1]), 0, None)  # in 2 % of rows
    moved = np.sin(2 * seen @ random.normal(size=(6, 20)))
    wanted = np.column_stack((moved, near)).astype(np.float32)
    steps = prediction.Steps(np.arange(20_000), seen, np.zeros((20_000, 1)), wanted)
    monkeypatch.setattr(prediction, "usual_horizons", lambda _: [10])
    alone = SimpleNamespace(encode=lambda rows: rows)
    known = SimpleNamespace(data=None, once=lambda *_: steps)
    (pair,) = prediction.problems(alone, known).values()
    together = Problem(steps.inputs(alone), wanted)
    *apart, joint = fit([*pair, together])
    told = [r2_score(near, each(together.values)[:, -1]) for each in (beside(*apart), joint)]
    assert told[0] > 0.3 > told[1] + 0.1


def test_probes_read_what_is_bent(held_out):
    weight = np.array([[3, 0, 0, 0], [0, 0, 3, 0]], np.float32)
    bent = Layer(weight, np.zeros(2, np.float32), "tanh")
    encoder = code(held_out.data, "place")
    encoder = Encoder(encoder.header, encoder.scaler, (bent,), ())
    nonlinear = probes(encoder, held_out, networks(encoder, held_out).probe)
    assert nonlinear["place"][0] > 0.98
    assert nonlinear["idle"][0] < 0.1


def test_needs_pass_from_what_is_rewarded_to_what_moves_it(held_out):
    full = code(held_out.data, *NAMES)
    needed = needs(full, held_out, None, networks(full, held_out)).controller
    assert min(needed[name] for name in NAMES[:3]) > 0.1 > needed["idle"]
    assert lost({"a": 0.5, "b": 0.9, "c": 0.05}, dict.fromkeys("abc", Score(0.2, 0, 1))) == (
        Lost(name="b", kept=0.2, need=0.9),
        Lost(name="a", kept=0.2, need=0.5),
    )
