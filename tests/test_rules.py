"""Verdicts by rules fixed beforehand: pairs, intervals, spreads, order, levels."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import beta, median_abs_deviation, ttest_rel

from jbrep.errors import InputError
from jbrep.stats.analysis import analyse
from jbrep.stats.claims import CLAIMS, Curves, log_spread, ratio_of_spreads, spread_p
from jbrep.stats.intervals import Bounds, mean_within
from jbrep.stats.labels import components
from jbrep.stats.pairs import pair_of
from jbrep.stats.power import obstacle, prospects
from jbrep.stats.rules import Planned, Rules, most_failing
from jbrep.stats.runs import RunCurve, with_failure_returns

RETURNS = Bounds(0, 1000)
STEPS = np.arange(0, 100_001, 10_000)
KEY = ("face_direction", "ddpg")
ALL = tuple(f"dae-12 {claim} than full" for claim in CLAIMS)
KEPT = ("dae-12 not worse than full", "dae-12 less variable than full", "dae-12 faster than full")


def curve(end, time=50_000, seed=0, name="full", **facts):
    """A run that stands still at 250 until it goes up within 10,000 steps to its final return."""
    rise = np.clip((STEPS - time) / 10_000 + 0.5, 0, 1)
    returns = 250 + (end - 250) * rise[:, None] + np.zeros((1, 3))
    usual = {"return_floor": 0, "return_ceiling": 1000, "reference": 250, "top": 950}
    usual["total_steps"] = 100_000
    return RunCurve(*KEY, name, seed, "", STEPS, returns, **(usual | facts))


def arm(name, finals, times=None, **facts):
    times = np.full(len(finals), 50_000) if times is None else times
    pairs = zip(finals, times, strict=True)
    return [curve(f, t, seed, name, **facts) for seed, (f, t) in enumerate(pairs)]


def drawn(mean, sd, runs, seed):
    """Numbers of exactly that mean and standard deviation."""
    values = np.random.default_rng(seed).standard_normal(runs)
    return mean + sd * (values - values.mean()) / values.std(ddof=1)


def verdicts(full, other, claims=KEPT, others=(), **rules):
    groups = {KEY: {"full": full, "dae-12": other, **dict(others)}}
    seeds = tuple(rules.pop("seeds", range(len(full))))
    return Planned(Rules(claims=claims, **rules), seeds, (KEY,))(groups)


def words(found):
    return [verdict.verdict for verdict in found]


@pytest.mark.parametrize("bounds", [RETURNS, Bounds(0), Bounds(-np.inf, 1000)])
def test_intervals_keep_to_what_is_possible(bounds):
    for values in (np.array([1, 2, 900.0]), np.array([999, 998, 100.0]), np.array([0, 1000.0])):
        mean, low, high = mean_within(values, bounds, 0.999)
        assert bounds.low <= low < mean < high <= bounds.high


def test_intervals_of_bounded_means_cover_the_truth():
    values = 1000 - np.random.default_rng(0).gamma(2, 60, (4000, 10))
    assert values.min() > 0
    found = mean_within(values, RETURNS, 0.95)
    assert 0.92 < np.mean((found.low < 880) & (found.high > 880)) < 0.97


def test_the_spread_of_curves_by_hand():
    curves = np.random.default_rng(0).normal(size=(7, 4))
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    by_hand = np.log(median_abs_deviation(curves, axis=0) + 0.01) @ weights
    assert log_spread(curves.T, weights, 0.01) == pytest.approx(by_hand)


def test_the_permutation_of_curves_swaps_sides_of_units():
    random = np.random.default_rng(3)
    x, y = random.normal(0, 1, (6, 1)), random.normal(0, 3, (6, 1))
    a, b = (v - np.median(v) for v in (x, y))
    each = []
    for swaps in product([False, True], repeat=6):
        p, q = np.where(np.array(swaps)[:, None], b, a), np.where(np.array(swaps)[:, None], a, b)
        spreads = (np.log(median_abs_deviation(v) + 1e-9)[0] for v in (p, q))
        each.append(next(spreads) - next(spreads))
    beyond = min(np.mean(each >= each[0] - 1e-9), np.mean(each <= each[0] + 1e-9))
    ours = spread_p(Curves(x, y, np.ones(1), 1e-9))
    assert ours == pytest.approx(min(1, 2 * beyond), abs=0.02)


def test_the_interval_of_a_ratio_of_spreads_is_what_the_test_keeps():
    random = np.random.default_rng(0)
    y = random.normal(0, 50, (16, 1)) + random.normal(0, 10, (16, 9))
    x = random.normal(0, 12, (16, 1)) + random.normal(0, 3, (16, 9))
    curves = Curves(x, y, np.full(9, 1 / 9), 1.0)
    value, low, high = ratio_of_spreads(curves, 0.95)
    assert low < value < high < 1
    assert spread_p(curves) < 0.05
    twice = ratio_of_spreads(curves._replace(x=2 * x), 0.95)
    np.testing.assert_allclose(twice, 2 * np.array([value, low, high]), rtol=2e-3)
    equal = Curves(y, y + 100, np.full(9, 1 / 9), 1.0)
    assert ratio_of_spreads(equal, 0.95).value == pytest.approx(1)
    assert spread_p(equal) > 0.9
    one_step = Curves(x[:12, :1], y[:12, :1] / 2, np.ones(1), 0.01)
    p = spread_p(one_step)  # and the interval at other levels, as of many claims, agrees with it
    assert ratio_of_spreads(one_step, 1 - 1.2 * p).high < 1
    assert ratio_of_spreads(one_step, 1 - 0.8 * p).high > 1


def measured(full, other, seeds=None):
    seeds = range(len(full)) if seeds is None else seeds
    return pair_of({"full": full, "dae-12": other}, "dae-12", "full", seeds)


def test_sides_are_measured_on_one_scale():
    full, other = arm("full", [850, 950]), arm("dae-12", [500, 900], [20_000, 60_000])
    pair = measured(full, other)
    np.testing.assert_array_equal(pair.y.final, [850, 950])
    assert pair.x.steps[0] == 100_000  # it never comes to half of the gain
    assert pair.x.steps[1] == pytest.approx(60_000, abs=5_000)
    assert pair.weights.sum() == pytest.approx(1)
    assert pair.ends == (250, 250, 950)
    assert measured(full, other, {1}) is None


def test_runs_are_paired_by_seed_whatever_their_order():
    """What seeds share is taken out: the p-value is that of a paired t-test."""
    shared = drawn(0, 60, 12, 0)
    full, other = arm("full", 700 + shared), arm("dae-12", 730 + shared + drawn(0, 9, 12, 1))
    finals = [[run.returns[-1, 0] for run in runs] for runs in (other, full)]
    found, *_ = verdicts(full, other[::-1], ALL[:1])
    assert found.p == pytest.approx(ttest_rel(*finals).pvalue)
    theirs = ttest_rel(*finals).confidence_interval(0.95)
    np.testing.assert_allclose(found.interval[1:], theirs)
    assert found.estimate.value == pytest.approx(30)


def test_curves_at_the_ceiling_spread_less():
    """They differ at one step alone, so no ratio makes them spread like the others."""
    flat = [curve(1000, 5_000, seed, "dae-12") for seed in range(16)]
    flat[0] = curve(1000, 12_000, 0, "dae-12")
    found = verdicts(arm("full", drawn(850, 40, 16, 0)), flat)
    assert words(found)[:2] == ["supported"] * 2
    assert found[1].estimate.value < 1e-3
    assert found[1].interval.high < 1


def test_agents_that_all_solve_a_task_have_learnt():
    found = verdicts(arm("full", [1000.0] * 16), arm("dae-12", drawn(600, 20, 16, 0)))
    assert found[0].verdict == "contradicted"
    alike = verdicts(arm("full", [1000.0] * 16), arm("dae-12", [1000.0] * 16))
    assert (alike[0].verdict, alike[0].reason) == ("undecided", "nothing varies from run to run")


def of_encoders(per_encoder=2, encoders=8, name="dae-12"):
    """Runs whose seeds go through the encoders in turn, each of which adds 10 more."""
    return [
        curve(
            600 + 10 * (seed % encoders) + seed, seed=seed, name=name, encoder_seed=seed % encoders
        )
        for seed in range(encoders * per_encoder)
    ]


def test_many_encoders_are_the_units():
    runs, full = of_encoders(), arm("full", drawn(850, 10, 16, 0))
    pair = measured(full, runs)
    assert (pair.units, pair.runs, pair.by_encoder) == (8, 16, True)
    means = [np.mean([run.returns[-1, 0] for run in runs[e::8]]) for e in range(8)]
    np.testing.assert_allclose(pair.x.final, means)
    np.testing.assert_allclose(pair.y.final, [np.mean([850]) + 0 * e for e in range(8)], atol=20)
    found, *_ = verdicts(full, runs, ("dae-12 better than full",))
    assert (found.units, found.by_encoder, found.runs) == (8, True, 16)
    few = [replace(run, encoder_seed=run.encoder_seed % 7) for run in runs]
    assert measured(full, few).units == 16


def test_the_last_evaluation_is_the_final_return():
    full = arm("full", [900.0] * 3)
    full = [replace(run, final=np.full(100, 900.0)) for run in full]
    runs = [curve(800, seed=seed, final=np.arange(700, 800.0), name="dae-12") for seed in (0, 1)]
    assert measured(full, runs).x.final == pytest.approx(749.5)
    failed = curve(800, seed=2, failed_at=70_000, name="dae-12", final=np.full(20, 850.0))
    np.testing.assert_allclose(measured(full, [*runs, failed]).x.final, [749.5, 749.5, 0])


FULL = arm("full", drawn(900, 30, 20, 0), drawn(50_000, 8_000, 20, 1))
BETTER = arm("dae-12", drawn(905, 5, 20, 2), drawn(30_000, 1_000, 20, 3))
WORSE = arm("dae-12", drawn(600, 30, 20, 4))
LIKE = drawn(901, 30, 20, 6)


def test_claims_are_tested_in_their_order():
    found = verdicts(FULL, BETTER, margin=0.2)  # as of twenty runs a seventh may fail, unseen
    assert [f"{v.x} {v.claim} than {v.y}" for v in found] == [*KEPT]
    assert words(found) == ["supported"] * 3
    kept, ratio, earlier = found
    assert kept.interval.low > kept.boundary == pytest.approx(-0.2 * (950 - 250))
    assert kept.width == 700
    assert ratio.estimate.value < 0.3
    assert earlier.estimate.value == pytest.approx(-20_000, abs=1_000)
    contradicted, *others = verdicts(FULL, WORSE)
    assert contradicted.verdict == "contradicted"
    assert contradicted.interval.high < contradicted.boundary
    assert {v.reason for v in others} == {"not tested: 'not worse' is contradicted"}
    assert words(others) == ["undecided"] * 2


def test_claims_may_be_of_any_two_representations():
    others = {"dae-8": arm("dae-8", drawn(400, 30, 20, 5)), "pca-8": arm("pca-8", LIKE)}
    claims = ("dae-12 better than dae-8", "dae-8 better than dae-12", "pca-8 better than full")
    found = verdicts(FULL, WORSE, claims, others.items())
    assert words(found) == ["supported", "contradicted", "undecided"]
    levels = [each.level for each in found]
    assert levels == pytest.approx([0.05 / 3, 0.05 / 3, 0.05])  # what the others no longer need


def test_what_may_fail_unseen_must_not_change_a_verdict():
    """Of ten runs that all learn, a quarter may fail, which no interval shows."""
    assert most_failing(0, 10, 0.05) == pytest.approx(1 - 0.05 ** (1 / 10))
    assert most_failing(3, 16, 0.05) == pytest.approx(beta.ppf(0.95, 4, 13))
    full = arm("full", drawn(600, 5, 10, 0))
    slightly, much = (arm("dae-12", drawn(end, 5, 10, 1)) for end in (650, 900))
    found = verdicts(full, slightly, ALL[:1])[0]
    assert (found.verdict, found.p < 1e-6) == ("undecided", True)
    assert "26 %" in found.reason
    assert words(verdicts(full, much, ALL[:1])) == ["supported"]  # even with 26 % of 650 less
    lower = arm("dae-12", drawn(560, 5, 10, 1))
    assert words(verdicts(full, lower, ALL[:1])) == ["undecided"]  # full may fail as often


def test_nothing_follows_from_agents_that_learn_nothing():
    idle = arm("full", drawn(250, 20, 20, 0))
    found = verdicts(idle, arm("dae-12", drawn(250, 10, 20, 1)))[0]
    assert found.reason == "agents on full aren't above the blind baselines"
    better = verdicts(idle, arm("dae-12", drawn(800, 10, 20, 1)), ALL[:1])
    assert words(better) == ["supported"]


def test_not_worse_takes_a_scale():
    unknown = [[replace(run, top=None) for run in runs] for runs in (FULL, BETTER)]
    found = verdicts(*unknown)[0]
    assert (found.verdict, "reference" in found.reason) == ("undecided", True)
    assert words(verdicts(*unknown, ALL[:1])) == ["undecided"]  # 905 against 900


def test_a_verdict_says_by_when_where_a_curve_still_rises():
    late = arm("full", drawn(600, 30, 16, 0), np.full(16, 90_000))
    early = arm("dae-12", drawn(900, 30, 16, 1), np.full(16, 20_000))
    found = verdicts(late, early, ALL[:1])[0]
    assert (found.verdict, found.by) == ("supported", 100_000)
    flat = arm("full", drawn(600, 30, 16, 0), np.full(16, 20_000))
    assert verdicts(flat, early, ALL[:1])[0].by is None


def test_there_is_no_verdict_before_all_planned_runs_have_ended():
    found = verdicts(FULL[:9], BETTER[:9], seeds=range(20))
    assert words(found) == ["undecided"] * 3
    assert {each.reason for each in found} == {"9 of 20 runs on dae-12 have ended"}
    assert np.isnan(found[0].estimate.value)


def test_a_verdict_depends_on_no_other_representation():
    """Where no least return is known, a failed run counts as the worst of the two."""
    full, other, worse = (
        arm(name, drawn(mean, 9, 32, len(name)), return_floor=None)
        for name, mean in (("full", 500), ("dae-12", 800), ("pca-4", -9000))
    )
    other[3] = replace(other[3], failed_at=90_000)
    claims, found = ("dae-12 better than full",), []
    for others in ((), (("pca-4", worse),)):
        found += verdicts(full, other, claims, others)
    assert found[0] == found[1]
    assert found[0].estimate.value > 200


@pytest.mark.parametrize(
    ("rules", "field"),
    [
        ({"margin": 0}, "margin"),
        ({"reference": float("nan")}, "reference"),
        ({"claims": ("dae-8 slower than full",)}, "claims"),
        ({"claims": ("full better than full",)}, "claims"),
        ({"claims": ("full better",)}, "claims"),  # than the baseline, which it is
        ({"claims": ("dae-8 better", "dae-8 better than full")}, "claims"),
    ],
)
def test_rules_that_contradict_one_another(rules, field):
    with pytest.raises(InputError, match=field):
        Rules(**rules)


def test_variance_components_are_those_of_restricted_maximum_likelihood():
    mixed = pytest.importorskip("statsmodels.api").MixedLM
    random = np.random.default_rng(2)
    returns = random.normal(0, 50, (9, 1)) + random.normal(700, 30, (9, 3))
    of_encoders, of_runs, ratio = found = components(returns)
    groups = np.repeat(np.arange(9), 3)
    theirs = mixed(returns.ravel(), np.ones((27, 1)), groups).fit(reml=True)
    assert of_encoders.value == pytest.approx(float(theirs.cov_re[0, 0]), rel=1e-3)
    assert of_runs.value == pytest.approx(theirs.scale, rel=1e-3)
    assert ratio.value == pytest.approx(of_encoders.value / of_runs.value)
    for each in found:
        assert 0 <= each.low < each.value < each.high


@pytest.mark.parametrize("ratio", [0.0, 4.0])
def test_intervals_of_variance_components_cover_the_truth(ratio):
    random = np.random.default_rng(0)
    covered = np.zeros(3)
    for _ in range(500):
        encoders = random.normal(0, np.sqrt(ratio), (8, 1))
        found = components(encoders + random.standard_normal((8, 2)))
        truths = zip(found, (ratio, 1, ratio), strict=True)
        covered += [each.low <= truth <= each.high for each, truth in truths]
    assert (covered / 500 > 0.925).all()


def test_what_cannot_be_supported_is_told_beforehand():
    better, kept, steady, _ = Rules(claims=ALL[:2] + KEPT[1:]).stated
    assert "7 runs" in obstacle(better, 7, 0.05)
    assert obstacle(kept, 8, 0.001) is None
    assert "p-value" in obstacle(steady, 8, 0.001)  # of eight units there are 256 swaps


def test_power_is_that_of_the_paired_t_test():
    power = pytest.importorskip("statsmodels.stats.power").TTestPower().power
    rules = Rules(claims=ALL[:2], error=0.04)
    planned = Planned(rules, tuple(range(16)), (KEY, ("move_to_pose", "ddpg")))
    found = [*prospects(planned, dict.fromkeys(rules.stated, 16))]
    assert [each.level for each in found] == [0.02] * 4
    better, kept = found[:2]
    for each, effect in ((better, 0.2), (kept, 0.1)):
        expected = [power(effect / sd, 16, 0.02, alternative="larger") for sd in (0.1, 0.2, 0.3)]
        one_sided = [power(effect / sd, 16, 0.01, alternative="larger") for sd in (0.1, 0.2, 0.3)]
        assert each.power == pytest.approx(one_sided, abs=1e-6)
        assert each.power < tuple(expected)


def test_half_of_a_gain_is_counted_on_the_starts_of_the_curve_that_comes_to_it():
    """The last evaluation's other starts return less: 50 of 1,000 in place of 250, then 350."""
    facts = {"reference": 50, "reference_in_training": 250, "final": np.full(20, 350.0)}
    runs = arm("full", drawn(850, 20, 8, 0), **facts)
    pair = measured(runs, [replace(run, representation="dae-12") for run in runs])
    assert (pair.ends.blind, pair.ends.blind_in_training) == (50, 250)
    assert pair.y.steps == pytest.approx(np.full(8, 50_000), abs=1000)
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
    assert measured(runs, longer).ends.blind == 250
    few, many = runs[0].returns.shape[1], len(facts["final"])
    played = {KEY[0]: {"standing still": [250.0] * few + [0.0] * (many - few)}}
    played[KEY[0]]["random"] = [0.0] * few + [250.0] * (many - few)  # what gains count over
    (group,) = analyse(runs + longer, references=played).groups
    assert group.cut
    assert group.best_policy == "standing still"
    assert (group.ends.blind, group.blind.value) == (250, 250)


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


def test_there_is_no_verdict_where_it_is_not_known_what_gains_count_over():
    planned = Planned(Rules(claims=ALL[:1]), tuple(range(len(FULL))), (KEY,))
    groups = {KEY: {"full": FULL, "dae-12": WORSE}}
    assert words(planned(groups)) == ["contradicted"]
    (found,) = replace(planned, prevented={"face_direction": "nobody stood still"})(groups)
    assert (found.verdict, found.reason) == ("undecided", "nobody stood still")


@pytest.mark.parametrize(("offset", "deviation"), [(-1000, 0.1), (0, 1)])
def test_what_an_interval_excludes_has_a_small_p(offset, deviation):
    """However far from 0 returns are, beside how much they differ."""
    random = np.random.default_rng(0)
    unknown = {"return_floor": None, "return_ceiling": None, "reference": None, "top": None}
    for _ in range(20):
        x, y = offset + deviation * random.normal(size=(2, 16))
        sides = (arm("full", y, **unknown), arm("dae-12", x + 0.7 * deviation, **unknown))
        (found,) = verdicts(*sides, ALL[:1])
        excluded = not found.interval.low <= 0 <= found.interval.high
        assert (found.p < 0.05) == excluded
