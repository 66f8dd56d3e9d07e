"""A study of a task with negative returns, no floor and no solved return: Pendulum's, made up."""

import numpy as np
import pytest

from jbrep.stats.analysis import analyse
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import RunCurve

TASK = "dm_control/pendulum-v0"
STEPS = np.arange(0, 20_001, 2000)
START = -1400.0  # the untrained policy's
WORST = -1612.0  # of any episode: one of pca-1, in the middle of training
# where runs of each representation end, and how far apart
LEVELS = {"full": (-200, 8), "dae-2": (-198, 1), "dae-1": (-260, 8), "pca-1": (-620, 60)}
SEEDS = 12
TOP = -150.0  # the return that scores 1, as a study's file gives it
CLAIMS = (
    *(f"dae-2 {claim} than full" for claim in ("not worse", "less variable", "faster")),
    *("dae-1 better than full", "pca-1 better than full"),
)


def make(name, seed, level, speed=3000, **changes):
    """A run that rises from the untrained policy's return to another, two episodes at a time."""
    random = np.random.default_rng([seed, *name.encode()])
    start = START + random.normal(0, 20)
    mean = level + (start - level) * np.exp(-STEPS / speed)
    returns = mean[:, None] + random.normal(0, 2, (len(STEPS), 2))
    if (name, seed) == ("pca-1", 3):
        returns[4, 1] = WORST
    facts = {"settings": "a1", "steps": STEPS, "returns": returns, "total_steps": 20_000}
    facts["top"] = TOP
    return RunCurve(
        **{"task": TASK, "algorithm": "sac", "representation": name, "seed": seed},
        **{**facts, **changes},
    )


def study():
    """Runs of which one of dae-1 failed at step 9,000, and one of pca-1 before any evaluation."""
    for name, (level, spread) in LEVELS.items():
        speed = 2000 if name == "dae-2" else 3000
        for seed, apart in enumerate(np.linspace(-1.6, 1.6, SEEDS)):
            changes = {"failed_at": 9000} if (name, seed) == ("dae-1", 5) else {}
            if (name, seed) == ("pca-1", 0):
                nothing = {"steps": np.zeros(0, np.int64), "returns": np.ones((0, 1))}
                changes = {**nothing, "failed_at": 0}
            yield make(name, seed, level + spread * apart, speed, **changes)


def judged(runs):
    """With a margin so wide that of twelve runs as many may fail unseen."""
    rules = Rules(claims=CLAIMS, margin=0.4, reference=TOP)
    return analyse(runs, Planned(rules, tuple(range(SEEDS)), ((TASK, "sac"),)))


@pytest.fixture(scope="module")
def runs():
    return list(study())


@pytest.fixture(scope="module")
def analysis(runs):
    return judged(runs)


@pytest.fixture(scope="module")
def group(analysis):
    return analysis.groups[0]


def result(group, name):
    return next(label for label in group.labels if label.representation == name)


def verdicts(analysis, name):
    return [(each.verdict, each.reason) for each in analysis.verdicts if each.x == name]


def test_a_failed_run_counts_as_the_worst_of_its_task_and_algorithm(group):
    assert group.failure_return == WORST
    failed = result(group, "dae-1")
    assert failed.failed == (5,)
    assert failed.by_run["final_return"][5] == WORST
    assert max(np.delete(failed.by_run["final_return"], 5)) < -200
    assert result(group, "pca-1").by_run["mean_return"][0] == WORST  # never evaluated


def test_failing_never_pays(runs):
    """Not even where all runs of a representation fail, nor where they fail from the start."""
    for at in (0, 4000):
        failed = [make("dae-2", seed, -190, failed_at=at) for seed in range(SEEDS)]
        kept = [run for run in runs if run.representation != "dae-2"]
        first, *others = verdicts(judged([*kept, *failed]), "dae-2")
        assert first == ("contradicted", None)
        assert others == [("undecided", "not tested: 'not worse' is contradicted")] * 2


@pytest.mark.parametrize("known", ["return_floor", "reference"])
def test_a_failed_run_counts_as_the_floor_or_at_most_as_a_blind_policy(runs, known):
    group = analyse([RunCurve(**{**vars(run), known: -3254.0}) for run in runs]).groups[0]
    assert group.failure_return == group.ends.blind == -3254
    assert result(group, "dae-1").by_run["final_return"][5] == -3254


def test_gains_are_counted_from_the_untrained_policy(group):
    full = result(group, "full")
    start = np.mean([make("full", seed, 0).returns[0].mean() for seed in range(SEEDS)])
    assert group.ends == (pytest.approx(start), pytest.approx(start), TOP)
    assert group.return_floor is None
    ends = [result(group, name).by_run["final_return"].mean() for name in ("full", "dae-2")]
    kept = group.comparisons[0].numbers["share_of_gain"].value
    assert kept == pytest.approx((ends[1] - start) / (ends[0] - start))
    half = group.thresholds["steps_to_50_percent"]
    assert half == pytest.approx((np.median(full.by_run["final_return"]) + start) / 2)
    assert full.numbers["steps_to_50_percent"].value == pytest.approx(3000 * np.log(2), rel=0.1)
    assert full.numbers["reached_90_percent"].value == 1


def test_each_verdict_can_be_reached(analysis):
    assert verdicts(analysis, "dae-2") == [("supported", None)] * 3
    assert verdicts(analysis, "pca-1") == [("contradicted", None)]
    assert verdicts(analysis, "dae-1") == [("undecided", None)]  # but for the failed run, similar
