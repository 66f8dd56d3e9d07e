"""Runs that learn together do what stable-baselines3 does with each alone."""

from contextlib import closing
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from small import assert_same_files
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.logger import Logger
from torch.nn import functional

from jbrep.encoders import find
from jbrep.envs import describe
from jbrep.envs.autoreset import AutoresetLanes
from jbrep.envs.lanes import EnvironmentFailedError
from jbrep.errors import InputError
from jbrep.rl import Run, StoppedError
from jbrep.rl.agent import (
    ACTIVATIONS,
    make_agent,
    make_env,
    parameters,
    trained_parts,
    training_seed,
)
from jbrep.rl.checkpoint import CheckpointFile
from jbrep.rl.cohort import ALGORITHMS, get_algorithm
from jbrep.rl.cohort.algorithm import Batch
from jbrep.rl.cohort.cohort import Cohort
from jbrep.rl.cohort.member import Member
from jbrep.rl.cohort.networks import Stack
from jbrep.rl.cohort.replay import ReplayBuffer
from jbrep.rl.cohort.trainer import _begin
from jbrep.rl.job import Job, Session
from jbrep.rl.overrides import overridden
from jbrep.rl.presets import PRESETS
from jbrep.rl.trainers import train_jobs
from jbrep.training.trainer import allocate_adam_state

TASK = describe("face_direction", max_episode_steps=50)
CODES = ("full", "dae-8", "pca-12")  # of 16, 8 and 12 numbers
ROWS = 32


@pytest.fixture
def in_float64(monkeypatch):
    """stable-baselines3 without its casts to float32."""
    name = "stable_baselines3.common.policies.preprocess_obs"
    monkeypatch.setattr(name, lambda seen, *_, **__: seen)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def precise(algorithm, preset, code, seed):
    """An agent in float64 with some transitions to learn from."""
    kwargs = {**preset.algorithm_kwargs, "buffer_size": 200}
    preset = preset.replace(algorithm_kwargs=kwargs)
    agent = make_agent(algorithm, preset, make_env(TASK, 1, 0, find(code, TASK)), seed)
    agent.set_logger(Logger(None, []))
    agent.policy.double()
    for _, part in trained_parts(agent):
        if isinstance(part, torch.optim.Optimizer):
            allocate_adam_state(part)
    random, buffer = np.random.default_rng(seed), agent.replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards"):
        setattr(buffer, name, np.tanh(random.normal(size=getattr(buffer, name).shape)))
    for name in ("dones", "timeouts"):
        setattr(buffer, name, (random.normal(size=getattr(buffer, name).shape) > 1).astype(float))
    buffer.full = True
    return agent


def drawn(agent, seed, draws):
    """What an agent's next gradient step with that seed learns from, filled up to 16 numbers."""
    np.random.seed(seed)  # noqa: NPY002 - stable-baselines3 draws there
    torch.manual_seed(seed)
    rows = agent.replay_buffer.sample(ROWS)
    wide = [functional.pad(x, (0, 16 - x.shape[1])) for x in (rows[0], rows[2])]
    normals = [torch.empty(ROWS, 1).normal_() for _ in range(draws)]
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)
    usual = torch.full_like(rows.rewards, agent.gamma)
    discounts = usual if rows.discounts is None else rows.discounts
    return Batch(wide[0], rows.actions, wide[1], rows.rewards, rows.dones, discounts), normals


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
@pytest.mark.parametrize("layers", [[4], [5, 7], [20, 13]])
def test_every_bit_is_that_of_a_network_alone(algorithm, layers):
    """Whatever the sizes: those that fill no vector of the processor, and no line of its cache."""
    used = overridden(algorithm, "modern", {"net_arch": layers, "buffer_size": 10})
    random, count, rows = torch.Generator().manual_seed(0), 17, 7

    def draw(*shape):
        return torch.randn(10, count, rows, *shape, generator=random)

    values, actions = [draw(16), draw(16), draw(1)], [draw(1).tanh(), draw(1), draw(1)]

    def learned(members):
        agents = [
            make_agent(algorithm, used, make_env(TASK, 1, 0, find("full", TASK)), seed)
            for seed in members
        ]
        for agent in agents:
            for _, part in trained_parts(agent):
                if isinstance(part, torch.optim.Optimizer):
                    allocate_adam_state(part)
        stack = Stack(agents, 16)
        learner = get_algorithm(algorithm)(stack)
        stack.read_from_agents()
        for step in range(10):
            seen, following, reward = (each[step, members] for each in values)
            action, *normals = (each[step, members] for each in actions)
            rest = torch.zeros_like(reward), torch.full_like(reward, 0.99)
            batch = Batch(seen, action, following, reward, *rest)
            learner.update(batch, normals[: learner.normals_to_learn], step + 1, 0)
        stack.write_to_agents()
        return [dict(parameters(agent)) for agent in agents]

    together = learned([*range(count)])
    for member in (0, 9, count - 1):
        (alone,) = learned([member])
        assert all(torch.equal(each, together[member][name]) for name, each in alone.items())


VARIANTS = [
    *((algorithm, preset, {}) for preset in PRESETS for algorithm in ALGORITHMS),
    ("sac", "modern", {"ent_coef": 0.1}),
    *(("ddpg", "modern", {"activation_fn": name}) for name in ACTIVATIONS),
    ("sac", "modern", {"ent_coef": "auto_0.2", "target_entropy": -0.5}),
    ("td3", "modern", {"policy_delay": 3, "activation_fn": "elu", "net_arch": [20, 10]}),
    ("sac", "modern", {"learning_rate": "linear:1e-3", "optimizer_kwargs": {"weight_decay": 0.1}}),
    ("sac", "modern", {"n_steps": 3}),
    ("td3", "modern", {"n_steps": 5}),
]


@pytest.mark.parametrize(("algorithm", "preset", "overrides"), VARIANTS)
def test_gradient_steps_are_those_of_stable_baselines3(in_float64, algorithm, preset, overrides):
    small = {"net_arch": [30, 20], **overrides}
    used = overridden(algorithm, preset, small)
    alone = [precise(algorithm, used, code, seed) for seed, code in enumerate(CODES)]
    together = [precise(algorithm, used, code, seed) for seed, code in enumerate(CODES)]
    stack = Stack(together, 16)
    learner = get_algorithm(algorithm)(stack)
    stack.read_from_agents()
    for step in range(1, 11):
        batches, normals = [], []
        for member, agent in enumerate(alone):
            batch, normal = drawn(agent, 100 * step + member, learner.normals_to_learn)
            batches.append(batch)
            normals.append(normal)
            agent._current_progress_remaining = 1 - step / 100
            agent.train(1, ROWS)
        stack.set_learning_rate(alone[0].lr_schedule(1 - step / 100))
        batch = Batch(*map(torch.stack, zip(*batches, strict=True)))
        normal = [torch.stack(each) for each in zip(*normals, strict=True)]
        losses = learner.update(batch, normal, step, 0)
    stack.write_to_agents()
    for member, (expected, agent) in enumerate(zip(alone, together, strict=True)):
        for (name, there), (_, here) in zip(parameters(expected), parameters(agent), strict=True):
            assert there.numpy() == pytest.approx(here.numpy(), rel=0, abs=1e-10), name
        for name, values in losses.items():
            assert expected.logger.name_to_value[f"train/{name}"] == pytest.approx(
                float(values[member])
            )


def runs(steps, preset="modern", **settings):
    """Three runs of one learner on different codes."""
    shared = {
        "task": TASK,
        "preset": preset,
        "evaluate_every": 100,
        "evaluation_episodes": 2,
        "final_episodes": 2,
    }
    return [
        Run.of(encoder=code, seed=seed, steps=steps, **shared, **settings)
        for seed, code in enumerate(CODES)
    ]


def together(given, folder, stop=lambda: False, save_every=1e9):
    """What becomes of runs, each in a folder named by its seed."""
    jobs = [Job(run, folder / str(run.seed)) for run in given]
    ended = train_jobs(jobs, Session(save_every=save_every, stop=stop))
    return {job.run.seed: result for job, result in ended}


def assert_same(folder, expected, seeds="012"):
    """What runs leave is the same, but for times."""
    for seed in seeds:
        names = "policy.zip", "episodes.csv", "evaluations.csv"
        assert_same_files(folder / seed, expected / seed, *names)


SAC = {"algorithm": "sac", "overrides": {"learning_starts": 60}}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """Three runs that were trained together."""
    folder = tmp_path_factory.mktemp("cohort")
    results = together(runs(260, **SAC), folder)
    assert [result.status for result in results.values()] == ["finished"] * 3
    return folder


FOLLOWED = [
    ("ddpg", "paper", {}),
    ("td3", "modern", {}),
    ("sac", "modern", {"num_envs": 2, "normalize": True}),
    ("td3", "wide", {"num_envs": 4}),
    ("sac", "modern", {"num_envs": 2, "n_steps": 3}),
    ("td3", "modern", {"num_envs": 2, "noise": {"kind": "coloured"}, "action_repeat": 2}),
    ("sac", "modern", {"n_steps": 3, "action_repeat": 3, "noise": {"kind": "coloured"}}),
]


# of a parameter's weights: a GPU sums products in another order, and a first step of Adam has the
# same size for a gradient that is hardly more than rounding
APART = {"cpu": 0, "cuda": 0.01}
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NO_GPU)])
@pytest.mark.parametrize(("algorithm", "preset", "overrides"), FOLLOWED)
def test_a_run_follows_that_of_stable_baselines3(algorithm, preset, overrides, device, tmp_path):
    """The same bits until the first gradient step; ten steps later, the same weights nearly."""
    settings = {"learning_starts": 100, **overrides}
    steps = 110 * overridden(algorithm, preset, settings).action_repeat
    made = runs(steps, preset, algorithm=algorithm, overrides=settings, device=device)
    members = [Member(Job(run, tmp_path / str(run.seed)), []) for run in made]
    cohort = Cohort(members)
    cohort.begin()
    while cohort.goes_on:
        for _ in range(cohort.rollout):
            cohort.act()
        cohort.learn()
    cohort.write_to_agents()
    for number, run in enumerate(made):
        agent = alone(run)
        assert agent._n_updates == members[number].agent._n_updates > 0
        buffer, rows = agent.replay_buffer, cohort._replay.rows_of(number)
        steps, size = len(rows), run.find_encoder().latent_size
        first = slice(0, 100 // run.learner.hyperparameters.num_envs)
        np.testing.assert_array_equal(buffer.observations[first], rows[first, :, :size])
        np.testing.assert_array_equal(buffer.rewards[first], rows[first, :, -3])
        np.testing.assert_allclose(buffer.rewards[:steps], rows[..., -3], atol=1e-5)
        for (name, there), (_, here) in zip(
            parameters(agent), parameters(members[number].agent), strict=True
        ):
            apart = ~(abs(here - there) <= 1e-5)  # also where one is NaN
            assert apart.float().mean() <= APART[device], name


def alone(run):
    """What stable-baselines3 makes of a run."""
    preset, seed = run.learner.hyperparameters, training_seed(run.seed)
    env = make_env(
        run.task,
        preset.num_envs,
        seed,
        run.find_encoder(),
        normalize=preset.normalize,
        action_repeat=preset.action_repeat,
    )
    steps = preset.agent_steps(run.task.max_episode_steps)
    agent = make_agent(run.learner.algorithm, preset, env, run.seed, steps)
    env.seed(seed)
    agent.set_logger(Logger(None, []))
    return agent.learn(preset.agent_steps(run.steps))


@pytest.mark.parametrize("added", [7, 10, 23])
def test_transitions_of_several_steps_are_those_of_stable_baselines3(added):
    """Over the ends of episodes, of the buffer and of what has been added."""
    space, random = spaces.Box(-1, 1, (1,), np.float32), np.random.default_rng(added)
    theirs = NStepReplayBuffer(20, space, space, n_envs=2, n_steps=4, gamma=0.9)
    ours = ReplayBuffer(1, 2, 20, 1, 1, 4, 0.9)
    for _ in range(added):
        seen, action, final = random.random((3, 1, 2, 1), np.float32)
        reward, ended = random.random((2,), np.float32), random.random(2) < 0.2
        terminated = ended & (random.random(2) < 0.5)
        flags = np.stack((terminated, ended), 1)[None]
        ours.add(seen, action, final, reward[None, :, None], flags)
        infos = [{"TimeLimit.truncated": each} for each in ended & ~terminated]
        theirs.add(seen[0], final[0], action[0], reward, ended, infos)
    np.random.seed(0)  # noqa: NPY002 - stable-baselines3 draws there
    expected, drawn = theirs.sample(100), np.random.RandomState(0)
    steps = drawn.randint(0, ours.filled, size=100)
    sampled = ours.sample(steps[None], drawn.randint(0, 2, size=100)[None])
    names = ("observations", "actions", "next_observations", "rewards", "dones", "discounts")
    for name, (values,) in zip(names, sampled, strict=True):
        np.testing.assert_array_equal(values, getattr(expected, name), err_msg=name)


def test_what_led_to_nothing_is_not_learned_from():
    """As a step in which the environment failed: the one before it ends the episode."""
    memory, ones = ReplayBuffer(1, 2, 8, 1, 1, 3, 0.9), np.ones((1, 2, 1), np.float32)
    for number in range(4):
        reward, goes_on = np.full_like(ones, number), np.zeros((1, 2, 2), bool)
        memory.add(number * ones, ones, (number + 1) * ones, reward, goes_on)
    memory.drop(np.array([[False, True]]))
    kept, lost = memory.rows_of(0)[:, 0], memory.rows_of(0)[:, 1]
    np.testing.assert_array_equal(kept[:, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(lost[:, 0], [0, 1, 2, 2])
    assert lost[:, -1].tolist() == [0, 0, 1, 1]
    (observation, _, final, reward, terminated, discount) = memory.sample(
        np.array([[1]]), np.array([[1]])
    )
    assert (observation.item(), final.item(), terminated.item()) == (1, 3, 0)
    assert reward.item() == pytest.approx(1 + 0.9 * 2)
    assert discount.item() == pytest.approx(0.9**2)


class Huge:
    """An encoder with which a critic's loss is infinite."""

    latent_size = 2

    def encode(self, observations):
        return observations[:, :2] + np.float32(1e25)


def test_a_member_that_diverges_fails_alone(done, tmp_path):
    first, second, third = runs(260, **SAC)
    results = together([first, second.replace(encoder=Huge()), third], tmp_path)
    assert results[1].reason == "train/critic_loss is inf after 64 steps"
    assert_same(tmp_path, done, "02")
    assert not (tmp_path / "1" / "policy.zip").exists()


@pytest.mark.parametrize(("call", "steps"), [("reset", 0), ("step", 130)])
def test_an_environment_that_fails_ends_its_run_alone(call, steps, done, tmp_path, monkeypatch):
    """The others go back to their last checkpoints."""
    asked, called = count(), getattr(AutoresetLanes, call)

    def fail_once(self, given):
        if next(asked) == steps:
            raise EnvironmentFailedError("the motor is broken", 2)
        return called(self, given)

    monkeypatch.setattr(AutoresetLanes, call, fail_once)
    results = together(runs(260, **SAC), tmp_path, save_every=0)
    assert results[2].reason == f"the motor is broken after {steps} steps"
    assert_same(tmp_path, done, "01")


def test_an_environment_that_fails_when_another_run_has_failed_is_its_own_runs(
    done, tmp_path, monkeypatch
):
    """The lanes of those that are left are numbered anew."""
    asked, restored = count(), AutoresetLanes.restore

    def fail_once(self, state):
        if not next(asked):
            raise EnvironmentFailedError("the motor is broken", 1)
        return restored(self, state)

    monkeypatch.setattr(AutoresetLanes, "restore", fail_once)
    first, second, third = runs(260, **SAC)
    results = together([first.replace(encoder=Huge()), second, third], tmp_path)
    assert results[0].reason == "train/critic_loss is inf after 64 steps"
    assert results[2].reason == "the motor is broken after 64 steps"
    assert_same(tmp_path, done, "1")


def test_the_time_of_a_run_is_its_own(tmp_path):
    """It doesn't begin when the run is planned, before others are trained."""
    (run, *_) = runs(64, **SAC)
    job = Job(run, tmp_path / "run")
    job.history._started -= 1000
    ((_, record),) = train_jobs([job], Session())
    assert 0 < record.seconds < 500


def check(run):
    return run.settings(run.find_encoder())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"trainer": "both"}, "trainer is 'both': it must be cohort or sb3"),
        ({"trainer": "cohort", "algorithm": "ppo"}, "cohorts train ddpg, td3, sac, not ppo: add"),
        ({"overrides": {"use_sde": True}}, "can't learn with use_sde = True: add --trainer sb3"),
        (
            {"preset": "modern", "overrides": {"train_freq": [1, "episode"]}},
            "takes train_freq as a number of steps: add",
        ),
        ({"trainer": "sb3", "precision": "bfloat16"}, "sb3 has no bfloat16: leave the precision"),
        ({"trainer": "sb3", "device": "cuda"}, "sb3 trains on the cpu here: leave the device out"),
        ({"precision": "half"}, "precision is 'half': it must be one of"),
        ({"device": "cuda"}, "no device 'cuda' on this machine: choose auto or cpu"),
        ({"overrides": {"sde_sample_freq": 3}}, "sde_sample_freq = 3: add --trainer sb3"),
    ],
)
def test_what_no_cohort_can_do_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        check(Run.of(task=TASK, **settings))


def test_members_do_not_depend_on_their_companions(done, tmp_path):
    first, second, third = runs(260, **SAC)
    together([third, first], tmp_path)
    together([second], tmp_path)
    assert_same(tmp_path, done)


@pytest.mark.parametrize("trainer", ["cohort", "sb3"])
def test_threads_that_step_robots_change_no_byte(trainer, tmp_path):
    run = runs(80, "wide", algorithm="td3", overrides={"num_envs": 4}, trainer=trainer)[0]
    for threads, folder in ((1, tmp_path / "one" / "0"), (3, tmp_path / "three" / "0")):
        job, most = Job(run, folder, threads), min(threads, 2)
        assert job.threads_for(2) == most
        with closing(job):
            assert job.evaluator._lanes.envs.unwrapped.simulation._batch.nthread == most
        [*_] = train_jobs([job], Session())
    assert_same(tmp_path / "three", tmp_path / "one", "0")


@pytest.mark.parametrize("rollouts", [0, 30])
def test_a_stopped_cohort_goes_on_to_the_same_bytes(rollouts, done, tmp_path):
    asked = count()
    with pytest.raises(StoppedError):
        together(runs(260, **SAC), tmp_path, stop=lambda: next(asked) == rollouts)
    first, *others = runs(260, **SAC)
    together(others, tmp_path)
    together([first], tmp_path)
    assert_same(tmp_path, done)
    assert not [*tmp_path.rglob("checkpoint.safetensors")]


def test_new_runs_learn_beside_those_that_were_stopped_before_their_first_step(done, tmp_path):
    first, *others = runs(260, **SAC)
    with pytest.raises(StoppedError):
        together([first], tmp_path, stop=lambda: True)
    together([first, *others], tmp_path)
    assert_same(tmp_path, done)


def test_whose_environment_fails_as_all_resume_is_named():
    def member(name):
        return SimpleNamespace(
            job=SimpleNamespace(checkpoint=CheckpointFile(Path(name), None, {}, None))
        )

    def failing(snapshots):
        raise EnvironmentFailedError("out of order", lane=1)

    members = [member("first"), member("second")]
    cohort = SimpleNamespace(members=members, restore=failing, member_of=members.__getitem__)
    with pytest.raises(InputError, match=r"^second can't be resumed: out of order"):
        _begin(cohort, [None, None])
