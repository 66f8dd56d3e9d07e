"""Verdicts by rules fixed beforehand: levels, intervals, spreads, order, looks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import (
    beta,
    median_abs_deviation,
    multivariate_normal,
    norm,
    permutation_test,
    ttest_1samp,
)

from jbrep.errors import InputError
from jbrep.report.words import shown
from jbrep.stats.analysis import analyse
from jbrep.stats.arms import Arm, Frame, Sides, measure
from jbrep.stats.claims import NOT_WORSE, kept_gain
from jbrep.stats.intervals import Bounds, difference_within, mean_within, p_of_difference
from jbrep.stats.nested import components
from jbrep.stats.power import Arms, obstacle
from jbrep.stats.rules import Planned, Rules, levels, most_failing
from jbrep.stats.runs import RunCurve, with_failure_returns
from jbrep.stats.spread import Curves, log_spread, ratio_of_spreads, spread_p

RETURNS = Bounds(0, 1000)
STEPS = np.arange(0, 100_001, 10_000)
KEY = ("face_direction", "ddpg")
HALF = "within half the margin"
CELL = "face_direction/ddpg/dae-12"


def test_looks_for_which_there_are_no_levels_are_told():
    with pytest.raises(InputError, match="no levels can be computed for looks at 1e-12, 1 of the"):
        levels((1e-12, 1.0), 0.05)


def curve(end, time=50_000, seed=0, name="full", **facts):
    """A run that stands still at 250 until it goes up within 10,000 steps to its final return."""
    rise = np.clip((STEPS - time) / 10_000 + 0.5, 0, 1)
    returns = 250 + (end - 250) * rise[:, None] + np.zeros((1, 3))
    usual = {"return_floor": 0, "return_ceiling": 1000, "reference": 250, "total_steps": 100_000}
    return RunCurve(*KEY, name, seed, "", STEPS, returns, **(usual | facts))


def arm(name, finals, times=None, **facts):
    times = np.full(len(finals), 50_000) if times is None else times
    pairs = zip(finals, times, strict=True)
    return [curve(f, t, seed, name, **facts) for seed, (f, t) in enumerate(pairs)]


def drawn(mean, sd, runs, seed):
    """Numbers of exactly that mean and standard deviation."""
    values = np.random.default_rng(seed).standard_normal(runs)
    return mean + sd * (values - values.mean()) / values.std(ddof=1)


def verdicts(full, other, primary=(CELL,), others=(), **rules):
    groups = {KEY: {"full": full, "dae-12": other, **dict(others)}}
    seeds = tuple(rules.pop("seeds", range(max(len(full), len(other)))))
    return Planned(Rules(**({"primary": primary} | rules)), seeds)(groups)[KEY]


def words(found):
    return [verdict.verdict for verdict in found]


@pytest.mark.parametrize(
    ("shares", "level", "constants"),
    [((0.5, 1.0), 0.05, (2.797, 1.977)), ((1 / 3, 2 / 3, 1.0), 0.05, (3.471, 2.454, 2.004))],
)
def test_levels_of_looks_are_those_of_o_brien_and_fleming(shares, level, constants):
    """The constants as textbooks have them (Jennison and Turnbull 2000, table 2.3)."""
    assert levels((0.05, 1.0), 0.05)[1] == pytest.approx(0.05, rel=1e-2)  # hardly a look
    z = norm.isf(np.array(levels(shares, level)) / 2)
    np.testing.assert_allclose(z, constants, atol=6e-4)
    ratios = np.divide.outer(shares, shares)
    together = multivariate_normal(cov=np.sqrt(np.minimum(ratios, 1 / ratios)))
    assert 1 - together.cdf(z, lower_limit=-z) == pytest.approx(level, rel=1e-3)
    assert levels((1.0,), level) == (level,)


def test_without_bounds_the_interval_of_a_mean_is_student_s():
    values = drawn(3, 2, 9, 0)
    theirs = ttest_1samp(values, 0).confidence_interval(0.9)
    np.testing.assert_allclose(mean_within(values, Bounds(), 0.9)[1:], theirs)
    p = p_of_difference(values, np.zeros(9), Bounds(), 2)
    assert p == pytest.approx(ttest_1samp(values, 2).pvalue, rel=1e-6)


@pytest.mark.parametrize("bounds", [RETURNS, Bounds(0), Bounds(-np.inf, 1000)])
def test_intervals_keep_to_what_is_possible(bounds):
    for values in (np.array([1, 2, 900.0]), np.array([999, 998, 100.0]), np.array([0, 1000.0])):
        mean, low, high = mean_within(values, bounds, 0.999)
        assert bounds.low <= low < mean < high <= bounds.high
        d, low, high = difference_within(values, values[::-1], RETURNS, 0.999)
        assert -1000 <= low < d < high <= 1000


def test_far_from_bounds_they_hardly_matter():
    values = drawn(500, 5, 12, 1)
    near = mean_within(values, RETURNS, 0.95)
    np.testing.assert_allclose(near, mean_within(values, Bounds(), 0.95), atol=0.05)


def test_intervals_of_bounded_means_cover_the_truth():
    random = np.random.default_rng(0)
    x, y = (1000 - random.gamma(2, 60, (4000, 10)) for _ in range(2))
    assert x.min() > 0
    one = mean_within(x, RETURNS, 0.95)
    assert 0.92 < np.mean((one.low < 880) & (one.high > 880)) < 0.97
    two = difference_within(x, y, RETURNS, 0.95, 0.9)
    assert 0.94 < np.mean((two.low < 88) & (two.high > 88)) < 0.98


def test_the_spread_of_curves_by_hand():
    curves = np.random.default_rng(0).normal(size=(7, 4))
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    by_hand = np.log(median_abs_deviation(curves, axis=0) + 0.01) @ weights
    assert log_spread(curves.T, weights, 0.01) == pytest.approx(by_hand)


def test_the_permutation_of_curves_is_scipy_s():
    random = np.random.default_rng(3)
    x, y = random.normal(0, 1, (5, 1)), random.normal(0, 3, (5, 1))

    def statistic(a, b, axis):
        spreads = (np.log(median_abs_deviation(v, axis=axis) + 1e-9) for v in (a, b))
        return next(spreads) - next(spreads)

    centred = [(v - np.median(v))[:, 0] for v in (x, y)]
    exact = permutation_test(
        centred, statistic, vectorized=True, n_resamples=np.inf, alternative="two-sided"
    ).pvalue
    ours = spread_p(Curves(x, y, np.ones(1), 1e-9), 0)
    assert ours == pytest.approx(exact, abs=0.02)


def test_the_interval_of_a_ratio_of_spreads_is_what_the_test_keeps():
    random = np.random.default_rng(0)
    y = random.normal(0, 50, (16, 1)) + random.normal(0, 10, (16, 9))
    x = random.normal(0, 12, (16, 1)) + random.normal(0, 3, (16, 9))
    curves = Curves(x, y, np.full(9, 1 / 9), 1.0)
    value, low, high = ratio_of_spreads(curves, 0.95, 0)
    assert low < value < high < 1
    assert spread_p(curves, 0) < 0.05
    twice = ratio_of_spreads(replace_x(curves, 2 * x), 0.95, 0)
    np.testing.assert_allclose(twice, 2 * np.array([value, low, high]), rtol=2e-3)
    equal = Curves(y, y + 100, np.full(9, 1 / 9), 1.0)
    assert ratio_of_spreads(equal, 0.95, 0).value == pytest.approx(1)
    assert spread_p(equal, 0) > 0.9


def replace_x(curves, x):
    return curves._replace(x=x)


def frame(**changes):
    usual = {"reference": 250, "half": 575, "bounds": Bounds(), "steps": 1e5}
    usual["half_in_training"] = usual["half"]
    return Frame(**(usual | changes), weights=np.ones(1), resolution=1.0)


def plain_arm(final):
    none = np.zeros(len(final))
    return Arm(final, none, none[:, None], len(final), len(final), by_encoder=False)


def test_what_is_kept_of_a_gain_ends_where_its_test_does():
    x, y = plain_arm(drawn(820, 60, 12, 0)), plain_arm(drawn(900, 30, 10, 1))
    sides = Sides(x, y, frame())
    share, low, high = kept_gain(sides, 0.95)
    assert share == pytest.approx((820 - 250) / (900 - 250))
    for end in (low, high):
        assert NOT_WORSE.p_value(sides, end, 0) == pytest.approx(0.05, rel=1e-4)
    moved = (plain_arm(3 * each.final - 7) for each in (x, y))
    found = kept_gain(Sides(*moved, frame(reference=3 * 250 - 7)), 0.95)
    np.testing.assert_allclose(found, (share, low, high))
    assert np.isnan(kept_gain(sides._replace(y=plain_arm(drawn(200, 10, 8, 2))), 0.95)).all()
    unsure = plain_arm(np.array([100, 900.0, 120, 880]))
    found = kept_gain(sides._replace(y=unsure), 0.95)
    assert found.high == np.inf
    assert shown(found) == "2.28 [0.588, unbounded]"
    assert found.tolist()[2] is None


def test_arms_are_measured_on_one_scale():
    full, other = arm("full", [850, 950]), arm("dae-12", [500, 900], [20_000, 60_000])
    scale, arms = measure({"full": full, "dae-12": other}, {0, 1})
    assert scale.half == (900 + 250) / 2
    np.testing.assert_array_equal(arms["full"].final, [850, 950])
    assert arms["dae-12"].time[0] == 100_000  # it never comes to half of the gain
    assert arms["dae-12"].time[1] == pytest.approx(60_000, abs=5_000)
    assert arms["dae-12"].learnt == 1
    assert scale.weights.sum() == pytest.approx(1)
    assert measure({"full": full, "dae-12": other}, {1})[1]["full"].runs == 1


def test_curves_at_the_ceiling_spread_less():
    """They differ at one step alone, so no ratio makes them spread like the others."""
    flat = [curve(1000, 5_000, seed, "dae-12") for seed in range(16)]
    flat[0] = curve(1000, 12_000, 0, "dae-12")
    found = verdicts(arm("full", drawn(850, 40, 16, 0)), flat)["dae-12"]
    assert words(found)[:2] == ["supported"] * 2
    assert found[1].estimate.value < 1e-3
    assert found[1].interval.high < 1


def test_agents_that_all_solve_a_task_have_learnt():
    found = verdicts(arm("full", [1000.0] * 16), arm("dae-12", drawn(600, 20, 16, 0)))["dae-12"]
    assert found[0].verdict == "contradicted"
    alike = verdicts(arm("full", [1000.0] * 16), arm("dae-12", [1000.0] * 16))["dae-12"]
    assert (alike[0].verdict, alike[0].reason) == ("undecided", "nothing varies from run to run")


def test_equal_spreads_of_few_and_many_are_told_apart_in_neither_direction():
    random = np.random.default_rng(0)
    found = []
    for _ in range(300):
        x, y = random.normal(size=(8, 1)), random.normal(size=(40, 1))
        sign = np.sign(x.std() - y.std())
        found.append(sign * (spread_p(Curves(x, y, np.ones(1), 0.01), 0, 499) <= 0.05))
    assert np.mean(np.array(found) < 0) < 0.05
    assert np.mean(np.array(found) > 0) < 0.06


def test_an_interval_of_a_test_agrees_with_its_p():
    """Also at the level of a first look of many cells."""
    random = np.random.default_rng(0)
    x, y = random.normal(0, 1, (12, 1)), random.normal(0, 9, (12, 1))
    curves = Curves(x, y, np.ones(1), 0.01)
    p = spread_p(curves, 0)
    assert p < 0.01
    assert ratio_of_spreads(curves, 1 - 1.2 * p, 0).high < 1
    assert ratio_of_spreads(curves, 1 - 0.8 * p, 0).high > 1


def test_encoders_are_the_units_of_what_may_fail():
    runs = [
        curve(900 + e, seed=8 * k + e, encoder_seed=e, name="dae-12")
        for k in (0, 1)
        for e in range(8)
    ]
    found = verdicts(arm("full", drawn(850, 10, 16, 0)), runs, looks=(1.0,))["dae-12"][0]
    assert found.encoders == 8
    assert found.reason == "up to 31 % of its encoders may fail to learn; the limit is 20 %"
    order = [seed for e in range(8) for seed in (e, 8 + e)]
    early = verdicts(arm("full", drawn(850, 10, 16, 0)), runs, seeds=order)["dae-12"][0]
    assert early.encoders == 8


def test_a_cell_without_runs_keeps_its_share():
    there = "face_direction/ddpg/dae-8"
    rough = arm("dae-8", drawn(850, 70, 20, 5))
    primary = (CELL, there, "face_direction/ddpg/pca-4")
    both = verdicts(FULL, WORSE, primary, {"dae-8": rough}.items(), looks=(1.0,))
    assert both["dae-8"][0].level == pytest.approx(0.025)


def test_many_encoders_are_the_units():
    runs = [
        curve(800 + e + 10 * k, seed=2 * e + k, encoder_seed=e) for e in range(9) for k in (0, 1)
    ]
    _, arms = measure({"full": runs}, range(18))
    assert (arms["full"].units, arms["full"].runs, arms["full"].by_encoder) == (9, 18, True)
    np.testing.assert_allclose(arms["full"].final, 805 + np.arange(9))
    few = [replace(run, encoder_seed=run.encoder_seed % 7) for run in runs]
    assert measure({"full": few}, range(18))[1]["full"].units == 18


def test_the_last_evaluation_is_the_final_return():
    runs = [curve(800, seed=seed, final=np.arange(700, 800.0)) for seed in (0, 1)]
    assert measure({"full": runs}, {0, 1})[1]["full"].final == pytest.approx(749.5)
    failed = curve(800, seed=2, failed_at=70_000, failure_return=0)
    finals = measure({"full": [*runs, failed]}, {0, 1, 2})[1]["full"].final
    np.testing.assert_allclose(finals, [749.5, 749.5, 0])


FULL = arm("full", drawn(900, 30, 20, 0), drawn(50_000, 8_000, 20, 1))
BETTER = arm("dae-12", drawn(905, 5, 20, 2), drawn(30_000, 1_000, 20, 3))
WORSE = arm("dae-12", drawn(600, 30, 20, 4))


def test_claims_are_tested_in_their_order():
    found = verdicts(FULL, BETTER)["dae-12"]
    assert [verdict.claim for verdict in found] == ["not worse", "less variance", "faster", HALF]
    assert words(found) == ["supported"] * 4
    kept, ratio, lost, narrowly = found
    assert kept.interval.low > kept.boundary == 0.9
    assert ratio.estimate.value < 0.3
    assert (narrowly.boundary, narrowly.estimate) == (0.95, kept.estimate)
    assert lost.estimate.value == pytest.approx(-20_000, abs=1_000)
    contradicted, *others = verdicts(FULL, WORSE)["dae-12"]
    assert contradicted.verdict == "contradicted"
    assert contradicted.interval.high < contradicted.boundary
    assert {v.reason for v in others} == {"not tested: 'not worse' is contradicted"}
    assert words(others) == ["undecided"] * 3


def test_the_order_can_be_another_but_for_the_first():
    found = verdicts(FULL, BETTER, claims=("not worse", "faster"))["dae-12"]
    assert [verdict.claim for verdict in found] == ["not worse", "faster"]


@pytest.mark.parametrize("runs", range(2, 8))
@pytest.mark.parametrize("name", ["better", "worse"])
def test_fewer_than_eight_runs_decide_nothing(runs, name):
    other = {"better": BETTER, "worse": WORSE}[name]
    for full, fewer in ((FULL[:runs], other), (FULL, other[:runs]), (FULL[:runs], other[:runs])):
        found = verdicts(full, fewer, seeds=range(runs), looks=(1.0,), failing=0.9)["dae-12"]
        assert words(found) == ["undecided"] * 4
        assert found[0].reason == f"{runs} runs; verdicts take 8"


def test_no_verdict_of_fewer_than_eight_units_can_be_made():
    sound = verdicts(FULL, BETTER)["dae-12"][0]
    for changes in ({"runs": (7, 20)}, {"runs": (20, 7)}, {"encoders": 7}):
        for verdict in ("supported", "contradicted"):
            with pytest.raises(ValueError, match=f"'not worse' is {verdict} by 7 runs or encoders"):
                replace(sound, verdict=verdict, **changes)
        assert replace(sound, verdict="undecided", **changes).verdict == "undecided"


def test_what_may_fail_often_is_not_called_as_good():
    """Of ten runs that all learn, a quarter may fail: the limit is a fifth."""
    found = verdicts(FULL[:10], BETTER[:10], looks=(1.0,))["dae-12"][0]
    assert (found.verdict, found.runs) == ("undecided", (10, 10))
    assert found.reason == "up to 26 % of its runs may fail to learn; the limit is 20 %"
    lenient = verdicts(FULL[:10], BETTER[:10], looks=(1.0,), failing=0.3)["dae-12"]
    assert words(lenient) == ["supported"] * 4
    assert most_failing(0, 10, 0.05) == pytest.approx(1 - 0.05 ** (1 / 10))
    assert most_failing(3, 16, 0.05) == pytest.approx(beta.ppf(0.95, 4, 13))


def test_nothing_follows_from_agents_that_learn_nothing():
    idle = arm("full", drawn(250, 20, 20, 0))
    found = verdicts(idle, arm("dae-12", drawn(250, 10, 20, 1)))["dae-12"]
    assert found[0].reason == "agents on the full state didn't clearly learn"


def test_the_baseline_and_the_error_are_the_study_s():
    other = "face_direction/ddpg/full"
    groups = {KEY: {"dae-12": arm("dae-12", drawn(250, 20, 20, 0)), "full": FULL}}
    rules = Rules(primary=(other,), baseline="dae-12", error=0.01, looks=(1.0,))
    (found, *_) = Planned(rules, tuple(range(20)))(groups)[KEY]["full"]
    assert found.reason == "agents on dae-12 didn't clearly learn"
    assert found.level == pytest.approx(0.01)


def test_nothing_is_said_between_looks():
    early = verdicts(FULL[:9], BETTER[:9], seeds=tuple(range(20)))["dae-12"]
    assert words(early) == ["not yet"] * 4
    assert all(np.isnan(verdict.estimate.value) for verdict in early)
    worse = arm("dae-12", [*drawn(500, 30, 10, 0), *drawn(900, 5, 9, 1)])
    half = verdicts(FULL[:19], worse, seeds=tuple(range(20)))["dae-12"][0]
    assert (half.verdict, half.look, half.runs) == ("contradicted", 1, (10, 10))
    assert half.level == pytest.approx(0.0052, abs=1e-4)
    later = verdicts(FULL, BETTER, looks=(0.5, 1.0))["dae-12"][0]
    assert (later.look, later.runs) == (2, (20, 20))  # with ten runs each some may fail
    assert later.level == pytest.approx(0.048, abs=1e-3)


def test_cells_share_the_level_and_pass_it_on():
    other = "face_direction/ddpg/dae-8"
    rough = arm("dae-8", drawn(850, 70, 20, 5))
    both = verdicts(FULL, WORSE, (CELL, other), {"dae-8": rough}.items(), looks=(1.0,))
    assert both["dae-12"][0].level == pytest.approx(0.025)
    assert both["dae-8"][0].level == pytest.approx(0.05)  # what dae-12 no longer needs


def test_what_is_not_primary_gets_no_verdict():
    found = verdicts(FULL, BETTER, primary=())["dae-12"]
    assert words(found) == ["exploratory"] * 4
    assert found[0].estimate.low > 0.9
    three = verdicts(FULL[:3], BETTER[:3], primary=())["dae-12"]
    assert np.isnan(three[0].estimate.low)
    assert three[0].estimate.value > 0.9


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"margin": 0}, "margin is 0: it must be a number above 0 and below 1"),
        ({"failing": 1.0}, "failing is 1.0"),
        ({"looks": (0.5,)}, r"looks are \[0.5\]: they must be shares of the seeds that ascend to"),
        ({"looks": (0.5, 0.5, 1.0)}, "ascend to 1"),
        ({"looks": (float("nan"), 1.0)}, "ascend to 1"),
        ({"claims": ("slower",)}, "unknown claim 'slower': choose of not worse, less variance"),
        ({"claims": ("faster",)}, "'not worse' comes first"),
        ({"claims": ("not worse", "faster", "faster")}, "each may be there once"),
    ],
)
def test_rules_that_contradict_one_another(rules, message):
    with pytest.raises(InputError, match=message):
        Rules(**rules)


def test_variance_components_are_those_of_restricted_maximum_likelihood():
    mixed = pytest.importorskip("statsmodels.api").MixedLM
    random = np.random.default_rng(2)
    returns = random.normal(0, 50, (9, 1)) + random.normal(700, 30, (9, 3))
    found = components(returns)
    groups = np.repeat(np.arange(9), 3)
    theirs = mixed(returns.ravel(), np.ones((27, 1)), groups).fit(reml=True)
    assert found.encoders.value == pytest.approx(float(theirs.cov_re[0, 0]), rel=1e-3)
    assert found.runs.value == pytest.approx(theirs.scale, rel=1e-3)
    assert found.ratio.value == pytest.approx(found.encoders.value / found.runs.value)
    for each in found:
        assert 0 <= each.low < each.value < each.high


def test_encoders_that_add_nothing_have_no_variance_below_0():
    returns = np.tile([600.0, 700.0, 800.0], (4, 1))
    found = components(returns)
    assert found.encoders[:2] == found.ratio[:2] == (0, 0)


@pytest.mark.parametrize("ratio", [0.0, 0.5, 4.0])
def test_intervals_of_variance_components_cover_the_truth(ratio):
    random = np.random.default_rng(0)
    covered = np.zeros(3)
    for _ in range(500):
        encoders = random.normal(0, np.sqrt(ratio), (8, 1))
        found = components(encoders + random.standard_normal((8, 2)))
        truths = zip(found, (ratio, 1, ratio), strict=True)
        covered += [each.low <= truth <= each.high for each, truth in truths]
    assert (covered / 500 > 0.925).all()


def test_the_bound_on_failing_runs_errs_as_rarely_as_the_test():
    """With n cells each has a share of the error, and more runs must learn."""
    arms = Arms(16, 16, 16)
    one, three = (Rules(primary=tuple("abc"[:n]), looks=(1.0,)) for n in (1, 3))
    assert obstacle(one, "not worse", arms) is None
    most = round(100 * (1 - (0.05 / 3) ** (1 / 16)))
    assert f"up to {most} % may fail" in obstacle(three, "not worse", arms)


def test_half_of_a_gain_is_counted_on_the_starts_of_the_curve_that_comes_to_it():
    """The last evaluation's other starts return less: 50 of 1,000 in place of 250, then 350."""
    facts = {"reference": 50, "reference_in_training": 250, "final": np.full(20, 350.0)}
    runs = arm("full", drawn(850, 20, 8, 0), **facts)
    frame, arms = measure({"full": runs}, range(8))
    assert (frame.reference, frame.half, frame.half_in_training) == (50, 200, 550)
    assert arms["full"].time == pytest.approx(np.full(8, 50_000), abs=1000)
    analysis = analyse(runs + [replace(run, representation="dae-12") for run in runs])
    (group,) = analysis.groups
    assert group.thresholds["steps_to_50_percent"] == pytest.approx(550, abs=10)
    assert group.labels[0].numbers["gain"].value == pytest.approx(600)
    assert group.labels[0].numbers["final_return_mean"].value == 350


def test_where_runs_are_cut_returns_are_held_to_what_those_starts_return():
    """Their last evaluations, of more starts, are at different steps and can't be compared."""
    facts = {"reference": 50, "reference_in_training": 250, "final": np.full(20, 350.0)}
    runs = arm("full", drawn(850, 20, 8, 0), **facts)
    longer = [
        replace(
            run,
            representation="dae-12",
            steps=np.append(run.steps, run.steps[-1] + 10_000),
            returns=np.concatenate((run.returns, run.returns[-1:])),
            total_steps=run.total_steps + 10_000,
        )
        for run in runs
    ]
    frame, _ = measure({"full": runs, "dae-12": longer}, range(8))
    assert (frame.reference, frame.half) == (250, 550)
    few, many = runs[0].returns.shape[1], len(facts["final"])
    played = {KEY[0]: {"standing still": [250.0] * few + [0.0] * (many - few)}}
    played[KEY[0]]["random"] = [0.0] * few + [250.0] * (many - few)  # what gains count over
    (group,) = analyse(runs + longer, references=played).groups
    assert group.cut
    assert group.reference_policy == "random"
    assert (group.reference, group.blind.value) == (250, 250)


def test_agents_that_stay_as_they_were_do_not_learn_by_beginning_elsewhere():
    nothing = {"return_floor": None, "reference": None, "final": np.full(20, 700.0)}
    (group,) = analyse([curve(250, seed=seed, **nothing) for seed in range(5)]).groups
    assert group.labels[0].learnt == "no"


def test_a_failed_run_is_as_bad_as_the_worst_start_of_all():
    bad, good = arm("full", drawn(-900, 20, 2, 0), return_floor=None)
    runs = [replace(bad, final=np.full(20, -5000.0)), good]
    assert {run.failure_return for run in with_failure_returns(runs)} == {-5000}


def test_no_step_comes_to_a_share_of_a_gain_that_curves_do_not_show():
    facts = {"reference": 10, "reference_in_training": 300, "final": np.linspace(38, 42, 20)}
    ends = drawn(280, 5, 8, 0)
    runs = [replace(run, final=run.final + i) for i, run in enumerate(arm("full", ends, **facts))]
    (group,) = analyse(runs + [replace(run, representation="dae-12") for run in runs]).groups
    names = ("steps_to_50_percent", "steps_to_90_percent")
    assert all(np.isnan(group.thresholds[name]) for name in names)
    assert group.labels[0].learnt == "yes"


def test_a_failed_run_counts_as_failed_whatever_it_was_played_from_at_its_end():
    ends = drawn(850, 20, 16, 0)
    good = [
        replace(run, final=np.full(20, end))
        for run, end in zip(arm("full", ends), ends, strict=True)
    ]
    bad = arm("dae-12", drawn(850, 20, 16, 1), final=np.full(20, 850.0), failed_at=90_000)
    verdict, *_ = verdicts(good, bad)["dae-12"]
    assert verdict.verdict == "contradicted"
    assert verdict.estimate.value == pytest.approx(-250 / 600, abs=0.02)


def test_fifteen_seeds_have_one_look():
    assert [Planned(seeds=tuple(range(n))).looks for n in (15, 16)] == [(1.0,), (0.5, 1.0)]


def test_there_is_no_verdict_where_it_is_not_known_what_gains_count_over():
    runs = {
        "full": arm("full", drawn(850, 20, 16, 0)),
        "dae-12": arm("dae-12", drawn(30, 1, 16, 1)),
    }
    planned = Planned(Rules(primary=(CELL,)), tuple(range(16)))
    (found,) = planned({KEY: runs})[KEY].values()
    assert found[0].verdict == "contradicted"
    prevented = replace(planned, prevented={"face_direction": "nobody stood still"})
    (found,) = prevented({KEY: runs})[KEY].values()
    assert {(each.verdict, each.reason) for each in found} == {("not yet", "nobody stood still")}


@pytest.mark.parametrize("runs", [10, 15, 20])
def test_only_the_runs_of_a_look_may_be_looked_at(runs):
    full, other = (arm(name, drawn(850, 80, 20, i)) for i, name in enumerate(("full", "dae-12")))
    planned = Planned(Rules(primary=(CELL,), failing=0.4), tuple(range(20)))
    analysis = analyse([*full[:runs], *other[:runs]], planned)
    (comparison,) = analysis.groups[0].comparisons
    assert comparison.verdicts[0].look == (2 if runs == 20 else 1)
    assert comparison.is_open == (runs != 15)
    (group,) = analysis.open_groups
    assert bool(group.comparisons[0].numbers) == comparison.is_open


def test_curves_that_do_not_differ_at_all_have_no_spread():
    x, y = np.full((8, 5), 3.0), np.random.default_rng(0).normal(0, 9, (8, 5))
    how = (np.full(5, 0.2), 1e-3)
    assert ratio_of_spreads(Curves(x, y, *how), 0.95, 0) == (0, 0, 0)
    assert ratio_of_spreads(Curves(y, x, *how), 0.95, 0)[::2] == (np.inf, np.inf)
    assert np.isnan(ratio_of_spreads(Curves(x, x, *how), 0.95, 0)).all()


@pytest.mark.parametrize(("offset", "deviation"), [(-1000, 0.1), (3000, 0.3), (-1e4, 1), (0, 1)])
def test_what_an_interval_excludes_has_a_small_p(offset, deviation):
    """However far from 0 returns are, beside how much they differ."""
    random, bounds = np.random.default_rng(0), Bounds()
    for _ in range(20):
        x, y = offset + deviation * random.normal(size=(2, 16))
        x += 1.2 * deviation
        _, low, high = difference_within(x, y, bounds, 0.95)
        excluded = not low <= 0 <= high
        assert (p_of_difference(x, y, bounds, 0) < 0.05) == excluded
