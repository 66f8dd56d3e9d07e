"""Which runs of a study learn in one cohort."""

import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest
from joblib import cpu_count

from jbrep.envs import describe
from jbrep.envs.instances import memory_of_each
from jbrep.errors import InputError
from jbrep.rl import Run, speed
from jbrep.rl.cohort.replay import memory_of
from jbrep.study import packing, plan
from jbrep.study.config import Data, Study
from jbrep.study.packing import packed, until_done, usual_workers
from jbrep.study.plan import Plan

STUDY = Study(
    tasks=("face_direction", "move_in_direction"),
    algorithms=("sac-modern", "ppo"),
    representations=("full", "dae-8", "dae-4"),
    seeds=(0, 1, 2, 3),
    steps=1000,
)


def packs_of(tmp_path, workers, width=None, **changes):
    """The packs of a study."""
    plan = Plan(STUDY.replace(**changes), tmp_path)
    packs = packed(plan, workers, width)
    assert sorted(c.name for pack in packs for c in pack) == sorted(c.name for c in plan.cells)
    for pack in packs:
        assert len({(cell.task, cell.learner.name) for cell in pack}) == 1
    return packs


@pytest.mark.parametrize(
    ("workers", "seeds", "sizes"),
    [(2, 4, [12, 12]), (1, 4, [12, 12]), (4, 4, [6] * 4), (3, 4, [4] * 6), (2, 6, [9] * 4)],
)
def test_packs_are_even(tmp_path, workers, seeds, sizes):
    packs = packs_of(tmp_path, workers, algorithms=("sac-modern",), seeds=tuple(range(seeds)))
    assert [len(pack) for pack in packs] == sizes


def test_the_first_seeds_go_first_in_all_tasks(tmp_path):
    packs = packs_of(tmp_path, 2, width=3, algorithms=("sac-modern",))
    order = [(pack[0].seed, pack[0].task) for pack in packs]
    assert order == [(seed, task) for seed in STUDY.seeds for task in STUDY.tasks]


def test_the_first_seeds_go_first_in_uneven_packs(tmp_path):
    packs = packs_of(tmp_path, 2, 5, algorithms=("sac-modern",), seeds=(0, 1, 2, 3, 4, 5, 6))
    order = [(len(pack), pack[0].seed) for pack in packs]
    assert order == [(5, 0), (5, 0), *[(4, seed) for seed in (1, 3, 4, 5) for _ in STUDY.tasks]]


def test_a_width_is_not_passed_and_what_has_no_cohort_goes_alone(tmp_path):
    packs = packs_of(tmp_path, 2, width=5)
    assert [len(pack) for pack in packs] == [4] * 6 + [1] * 24
    assert {pack[0].learner.name for pack in packs[6:]} == {"ppo"}
    alone = packs_of(tmp_path, 2, algorithms=("sac-modern",), trainer="sb3")
    assert [len(pack) for pack in alone] == [1] * 24


def test_memory_limits_the_width(tmp_path, monkeypatch):
    plan = Plan(STUDY.replace(algorithms=("sac-modern",), steps=1_000_000), tmp_path)
    bytes_of_one = memory_of(plan.run(plan.cells[0]), 16)
    assert bytes_of_one == 1_000_000 * (16 + 1 + 16 + 1 + 1 + 1) * 4
    gib = 1 << 30
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 4, "SC_PAGE_SIZE": gib}.__getitem__)
    packs = packed(plan, 2)
    assert max(map(len, packs)) == 4  # of 19 features, 0.9 GiB
    with pytest.raises(InputError, match="the width is 5: 2 cohorts of 4 agents are the most that"):
        packed(plan, 2, 5)
    alone = Plan(plan.study.replace(trainer="sb3"), tmp_path)
    assert {*map(len, packed(alone, 4))} == {1}
    with pytest.raises(InputError, match="doesn't hold an agent for each of 40 workers"):
        packed(alone, 40)


def test_the_last_worker_decides():
    assert until_done([3, 1, 1, 1], 2) == 3
    assert until_done([2, 2, 2], 2) == 4
    assert until_done([], 2) == 0


def test_a_gpu_has_one_wide_cohort_at_a_time(tmp_path, monkeypatch):
    plan = Plan(STUDY.replace(algorithms=("sac-modern",), seeds=tuple(range(20))), tmp_path)
    assert usual_workers(plan) == cpu_count()
    monkeypatch.setattr(Plan, "device", "cuda")
    assert usual_workers(plan) == 1
    assert [len(pack) for pack in packed(plan, 1)] == [60, 60]


@pytest.mark.parametrize(
    ("algorithm", "short"),
    [("ddpg", {"train_freq": 2, "gradient_steps": 1}), ("td3", {"train_freq": 1}), ("sac", {})],
)
def test_trials_take_rollouts_as_short_as_can_be(algorithm, short):
    """The paper's TD3 takes a thousand gradient steps after as many steps."""
    run = Run.of(task="face_direction", algorithm=algorithm, preset="paper")
    found = speed._at_once(run)
    assert {"learning_starts": 0, **short}.items() <= found.items()
    run = run.replace(learner=run.learner.overridden(found))
    run.settings(run.find_encoder())


def test_codes_that_are_larger_than_the_observation_take_more_memory(tmp_path, monkeypatch):
    data = {"": Data(steps=1000)}
    study = STUDY.replace(algorithms=("sac-modern",), steps=1_000_000, data=data)
    gib = 1 << 30
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 4, "SC_PAGE_SIZE": gib}.__getitem__)
    wide = Plan(study.replace(representations=("full", "noise-64")), tmp_path)
    assert max(map(len, packed(wide, 2))) == 1  # 0.5 GiB each, of 0.9


def test_codes_that_are_larger_than_the_observation_have_packs_of_their_own(tmp_path):
    """They can't be in one cohort with others, so in one pack they would wait for it to end."""
    codes = {"representations": ("full", "dae-8", "noise-38"), "data": {"": Data(steps=1000)}}
    packs = packs_of(tmp_path, 2, algorithms=("sac-modern",), **codes)
    seen = [{cell.representation.name for cell in pack} for pack in packs]
    assert all(names == {"noise-38"} or "noise-38" not in names for names in seen)


def test_robots_take_memory_beside_what_agents_remember(tmp_path):
    """64 of dm_control's cheetahs take nearly a gigabyte, more than an agent's replay memory.

    A process of its own measures it: what tests before have left would be used again.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as processes:
        packs = processes.submit(packs_of_cheetahs, tmp_path).result()
    assert 1 <= max(map(len, packs)) <= 4
    assert memory_of_each(describe("face_direction")) == 0


def packs_of_cheetahs(folder):
    packing.memory = lambda: 8 << 30
    cheetah = {"tasks": ("dm_control/cheetah-run-v0",), "algorithms": ("sac-wide",)}
    return packs_of(folder, 2, **cheetah, representations=("full",), seeds=tuple(range(20)))


def test_robots_are_measured_once_however_often_a_study_is_packed(tmp_path, monkeypatch):
    measured = []
    monkeypatch.setattr(plan, "memory_of_each", lambda task: measured.append(task.name) or 0)
    study = Plan(STUDY.replace(algorithms=("sac-modern",)), tmp_path)
    assert packed(study, 2) == packed(study, 2)
    assert measured == list(STUDY.tasks)
