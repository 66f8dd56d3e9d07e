"""Policies as functions of observations: they act as the runs that they were taken from."""

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import torch

import jbrep
from jbrep.envs.description import describe
from jbrep.envs.environments import Environments
from jbrep.errors import InputError
from jbrep.rl import Run, train
from jbrep.rl.agent import acting
from jbrep.rl.controller import Controller, load_policy
from jbrep.rl.normalization import Statistics
from jbrep.rl.policy import build
from jbrep.rl.presets import ALGORITHMS

TASK = describe("move_to_pose", episode_steps=200)
SETTINGS = {
    **{name: {"net_arch": [24, 16]} for name in ALGORITHMS},
    "td3": {"net_arch": [24], "activation_fn": "leaky_relu", "action_repeat": 3},
    "ppo": {"net_arch": [24, 16], "activation_fn": "tanh", "normalize": True},
    "a2c": {"net_arch": [], "normalize": True},
    "crossq": {"net_arch": [24, 16], "activation_fn": "elu", "batch_norm_eps": 0.5},
}


def randomised(algorithm, encoder, task=TASK):
    """An untrained policy with weights and statistics that nothing in it can hide."""
    run = Run.of(task, algorithm, overrides=SETTINGS[algorithm], encoder=encoder)
    known = run.find_encoder()
    trained = build(run.settings(known), known, Path("here"))
    random = np.random.default_rng(4)
    for name, values in acting(trained.policy).state_dict().items():
        if values.is_floating_point():
            drawn = random.normal(size=values.shape) / (values.shape[-1] + 4) ** 0.5
            positive = name.endswith(("scale", "var"))
            values.copy_(torch.from_numpy(np.abs(drawn) + 0.5 if positive else drawn))
    if trained.statistics is None:
        return trained
    size = known.latent_size
    statistics = Statistics(random.normal(size=size), random.uniform(0.5, 2, size), 100.0)
    return trained._replace(statistics=statistics)


def controller_of(trained):
    weights = {name: each.numpy() for name, each in acting(trained.policy).state_dict().items()}
    return Controller(trained.settings, trained.encoder, weights, trained.statistics)


def difference_over_an_episode(trained, controller, steps=200):
    """The greatest difference between the actions of both, of which the policy's are carried out.

    The spread of these actions is given, too: a policy of one action would be like any other.
    """
    envs = Environments(trained.task, 1)
    envs.reset([0], [3])
    act, pairs = trained.begin(trained.task, [3]), []
    for _ in range(steps):
        ours, theirs = controller(envs.observation[0]), act(envs.observation)[0]
        pairs.append((ours, theirs))
        envs.step(theirs[None])
    ours, theirs = map(np.array, zip(*pairs, strict=True))
    return np.abs(ours - theirs).max(), theirs.std()


@pytest.mark.parametrize(
    ("algorithm", "encoder"), [*zip(ALGORITHMS, cycle(("full", "symmetry", "dae-8")), strict=False)]
)
def test_a_controller_acts_as_its_run(algorithm, encoder):
    trained = randomised(algorithm, encoder)
    worst, spread = difference_over_an_episode(trained, controller_of(trained))
    assert worst < 2e-6
    assert spread > 1e-3


def test_it_holds_actions_and_begins_again(tmp_path):
    controller = controller_of(randomised("td3", "full"))
    rows = np.random.default_rng(0).normal(size=(5, TASK.size))
    first, *others = (controller(row) for row in rows)
    assert [np.array_equal(first, each) for each in others] == [True, True, False, False]
    controller.reset()
    assert not np.array_equal(controller(rows[4]), others[-1])
    first[:] = 9  # what the caller does with an action changes none that follows
    assert np.abs(controller(rows[0])).max() <= 1


SEEN = [0.0, 1.0, 0.0]


def test_the_policy_of_a_folder_and_of_a_file(tmp_path):
    class Doubled(torch.nn.Module):
        def forward(self, rows):
            return torch.cat([rows, rows.sin()], -1)  # no chain of layers

    task, encoder = describe("Pendulum-v1", episode_steps=20), Doubled()
    quick = {"steps": 64, "evaluation_episodes": 1, "final_episodes": 1}
    agent = jbrep.train(task, tmp_path / "own", algorithm="a2c", encoder=encoder, **quick)
    assert load_policy(tmp_path / "own", encoder)(SEEN) == agent.policy(SEEN)
    with pytest.raises(InputError, match=r"needs it again, as in jbrep\.load_policy"):
        load_policy(tmp_path / "own")
    train(Run.of(task, "a2c", **quick), tmp_path / "full")
    assert load_policy(tmp_path / "full/policy.zip")(SEEN) == load_policy(tmp_path / "full")(SEEN)


@pytest.mark.parametrize("history", [1, 2])
def test_what_is_refused_changes_nothing(history):
    """A policy that sees less takes no more; steps that hold an action are checked, too."""
    seen = describe("Pendulum-v1", hide=["obs_0"], history=history)
    run = Run.of(seen, "sac", preset="paper", overrides={"action_repeat": 2})
    encoder = run.find_encoder()
    trained = build(run.settings(encoder), encoder, Path("here"))
    controller, other = controller_of(trained), controller_of(trained)
    refused = [
        ([0.3], "takes 2 numbers"),
        ([0.3] * (2 * history + 2), "takes 2 numbers"),  # of which it would take the first two
        (0.3, "takes 2 numbers"),
        ([0.1, np.nan], "obs_2 is missing or not finite: .* for 0 steps in a row"),
    ]
    several = [[0.1, 0.2]] * 3
    for step in range(4):
        for wrong, why in [*refused, (several, r"\(3, 2\)")] if step else refused:
            with pytest.raises(InputError, match=why):
                controller(wrong)
        np.testing.assert_array_equal(controller([0.1 * step, 0.2]), other([0.1 * step, 0.2]))
    controller.reset()
    assert controller(several).shape == (3, 1)


def test_an_action_that_is_not_finite_is_refused():
    controller = controller_of(randomised("td3", "full"))
    with np.errstate(all="ignore"), pytest.raises(InputError, match="action is not finite"):
        controller(np.full(TASK.size, 1e38))
    assert controller(np.zeros(TASK.size)).shape == (TASK.action_size,)  # there is none to hold


@pytest.mark.parametrize("hold", [0, 2])
def test_steps_that_are_late_or_miss_readings_have_those_before(hold):
    """As if the last reading had come again; longer, or before any, it is refused."""
    seen = describe("Pendulum-v1", history=3)
    run = Run.of(seen, "sac", preset="paper", overrides={"action_repeat": 4})
    encoder = run.find_encoder()
    trained = build(run.settings(encoder), encoder, Path("here"))
    late, whole = controller_of(trained), controller_of(trained)
    late.hold = whole.hold = hold
    rows = np.random.default_rng(1).normal(size=(9, 3)).astype(np.float32)
    for controller in (late, whole):
        with pytest.raises(InputError, match="not finite"):
            controller([0.1, np.nan, 0.2])
        controller.reset()
        controller(rows[0], step=40)
        controller(rows[1], step=41)
    if not hold:
        for lacking, step in ((None, None), (rows[2], 43)):
            with pytest.raises(InputError, match="not finite"):
                late(lacking, step)
        np.testing.assert_array_equal(late(rows[2]), whole(rows[2]))
        return
    whole(rows[1])
    whole(rows[1])  # the two steps that are left out
    np.testing.assert_array_equal(late(rows[4], step=44), whole(rows[4]))
    filled = np.where([False, True, False], rows[4], rows[5])
    lacking = [rows[5][0], np.nan, rows[5][2]]
    np.testing.assert_array_equal(late(lacking, step=45), whole(filled))
    np.testing.assert_array_equal(late(None), whole(filled))
    with pytest.raises(InputError, match="not finite"):
        late(None)
    with pytest.raises(InputError, match="step 46 after step 46"):
        late(rows[6], step=46)
    alone = late(rows[6])
    np.testing.assert_array_equal(alone, whole(rows[6]))
    np.testing.assert_allclose(late(rows[7:8]), whole(rows[7])[None], atol=1e-6)
