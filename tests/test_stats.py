"""Statistics over runs: against closed forms, scipy, rliable, and simulations of known truth."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, stats

from jbrep.errors import InputError
from jbrep.stats.analysis import aggregates, analyse, probability_of_improvement, to_plain
from jbrep.stats.curves import (
    bands,
    common_grid,
    compared,
    final_return,
    iqm,
    mean_return,
    on_grid,
    rise,
    steps_to,
)
from jbrep.stats.intervals import (
    Bounds,
    deviation,
    mean_within,
    percentile,
    rank_correlation,
    share_of_gain,
    variance_ratio,
)
from jbrep.stats.labels import components, expected_shortfall
from jbrep.stats.pairs import linked_units
from jbrep.stats.rules import Planned, Rules
from jbrep.stats.runs import RunCurve, groups

GRID = np.arange(0, 10_001, 1000)


def make(representation="full", seed=0, level=500.0, **changes):
    """A run that rises to a return, with three episodes an evaluation."""
    steps = changes.pop("steps", GRID)
    noise = np.random.default_rng([seed or 0, len(representation)]).normal(0, 3, (len(steps), 3))
    rise = level * (1 - np.exp(-np.asarray(steps) / 2000))
    facts = {"task": "face_direction", "algorithm": "sac", "representation": representation}
    facts |= {"seed": seed, "settings": "a1", "steps": steps, "total_steps": 10_000}
    facts |= {"returns": np.clip(rise[:, None] + noise, 0, 1000)}
    facts |= {"return_floor": 0.0, "reference": 0.0, "solved": 900.0}
    return RunCurve(**{**facts, **changes})


def study(levels):
    """Runs of each representation with those final levels."""
    return [make(name, i, level) for name, of in levels.items() for i, level in enumerate(of)]


@pytest.fixture(scope="module")
def runs():
    random = np.random.default_rng(0)
    levels = {name: random.normal(500, 20, 6) for name in ("full", "dae-8", "dae-4")}
    levels["dae-4"] -= 200
    return study(levels)


@pytest.fixture(scope="module")
def analysis(runs):
    return analyse(runs)


def test_a_run_that_fails_near_the_end_ends_with_the_worst_too(runs):
    """Without evaluations of more starts; after the last step compared it hasn't failed yet."""
    late = make("dae-8", 9, 900, failed_at=9999)
    longer = make("dae-8", 10, 500, total_steps=12_000, failed_at=11_000)
    (group,) = groups([*runs, late, longer], "full").values()
    found = compared(group)
    assert not found.on_all_starts
    assert found.finals["dae-8"][-2] == 0
    assert found.finals["dae-8"][-1] > 450


def test_one_run_beats_another_as_often_as_pairs_do():
    x, y = np.random.default_rng(0).integers(0, 5, (2, 7, 6)).astype(float)
    pairs = (1 + np.sign(x[:, :, None] - y[:, None, :4]).mean(axis=(1, 2))) / 2
    np.testing.assert_allclose(probability_of_improvement(x, y[:, :4]), pairs)


def test_all_are_compared_with_the_baseline(runs, analysis):
    (against,) = analyse(runs, Planned(Rules(baseline="dae-8"))).groups
    assert [each.representation for each in against.labels] == ["dae-8", "dae-4", "full"]
    (group,), tested = analysis.groups, "final_return_difference"
    (there,) = (c for c in group.comparisons if c.representation == "dae-8")
    (back,) = (c for c in against.comparisons if c.representation == "full")
    assert there.numbers[tested].value == pytest.approx(-back.numbers[tested].value)


def mean(values):
    return mean_within(values, Bounds(), 0.95)


def shapes(n, random, studies=3000):
    """Returns of runs with mean 500 and SD 30, as most samples of each shape: normal, skewed, t."""
    yield random.normal(500, 30, (studies, n))
    yield 500 - 30 * (random.gamma(2, size=(studies, n)) - 2) / np.sqrt(2)
    yield 500 + 30 * random.standard_t(5, (studies, n)) / np.sqrt(5 / 3)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"returns": np.full((11, 3), -1.0)}, "its task says that returns are from 0"),
        ({"return_ceiling": 400.0}, "its task says that returns are from 0 to 400"),
        ({"final": np.full(5, -9.0)}, "it returned -9"),
        ({"steps": np.array([10_000]), "returns": np.ones((1, 9))}, "evaluations"),
    ],
)
def test_invalid_runs_are_refused(changes, named):
    with pytest.raises(InputError, match=named):
        make(**changes)


NONE = np.zeros(0, np.int64)
TWO = [make(seed=0), make(seed=1)]
UNSEEN = {"steps": NONE, "returns": np.ones((0, 1)), "failed_at": 0, "return_floor": None}


@pytest.mark.parametrize(
    ("runs", "named"),
    [
        ([], "there are no runs"),
        ([*TWO, make(seed=2, settings="b2")], "settings a1, b2"),
        ([make("dae-8", 0), make("dae-8", 1)], "baseline 'full'"),
        ([*TWO, make(seed=2, environment="Robot-v0, body=5")], "different environments"),
        ([*TWO, make("dae-8", seed=2, learner="b2")], "different learners"),
        ([*TWO, make(seed=2, returns=np.ones((11, 2)))], "episodes: report runs"),
        ([make(seed=i, **UNSEEN) for i in range(2)], "failed before its first evaluation"),
        (
            [*TWO, make(seed=2, steps=np.array([10_000, 12_000]), total_steps=12_000)],
            "one run end at step 10000, those of another begin at 10000",
        ),
    ],
)
def test_studies_that_would_mislead(runs, named):
    with pytest.raises(InputError, match=named):
        analyse(runs)


def test_runs_with_other_grids_are_compared_where_all_have_evaluations():
    fine = make(seed=0, steps=np.arange(0, 8001, 100))
    coarse = make(seed=1, steps=np.arange(500, 10_000, 1500))
    grid, cut = common_grid({"full": [fine, coarse]})
    np.testing.assert_array_equal(grid, [500, 2000, 3500, 5000, 6500, 8000])
    assert cut == "ends at step 8,000 with full, seed 0; the longest run has 9,500"
    expected = coarse.returns.mean(axis=1)
    np.testing.assert_allclose(on_grid(coarse, grid)[:-1], expected[:5])
    inside = [7.5 / 15 * expected[5] + 7.5 / 15 * expected[4]]
    np.testing.assert_allclose(on_grid(coarse, np.array([7250])), inside)
    assert common_grid({"full": TWO})[1] is None


def test_a_failed_run_counts_as_zero_and_does_not_shorten_the_others():
    failed = make(seed=2, steps=GRID[:5], failed_at=3500)
    never = make(seed=3, steps=NONE, returns=np.ones((0, 1)), failed_at=10, total_steps=5000)
    grid, cut = common_grid({"full": [*TWO, failed, never]})
    np.testing.assert_array_equal(grid, GRID)
    assert cut is None
    curve = on_grid(failed, grid)
    np.testing.assert_allclose(curve[:4], failed.returns.mean(axis=1)[:4])
    assert not curve[4:].any()  # though it was evaluated at step 4000, too
    assert not on_grid(replace(failed, failed_at=3000), grid)[3:].any()
    assert not on_grid(never, grid).any()
    found = analyse([*TWO, failed, never]).groups[0].labels[0]
    assert found.failed == (2, 3)
    np.testing.assert_array_equal(found.by_run["final_return"][2:], 0)


def test_a_label_whose_runs_all_failed_is_described():
    failed = [make("dae-8", i, steps=NONE, returns=np.ones((0, 1)), failed_at=0) for i in range(3)]
    found = analyse([*TWO, *failed])
    assert found.groups[0].labels[1].numbers["final_return_mean"].tolist() == [0, None, None]
    alone = analyse([replace(run, representation="full") for run in failed])
    assert alone.groups[0].labels[0].numbers["steps_to_50_percent"].tolist() == [None] * 3
    json.dumps(to_plain(alone.groups), allow_nan=False)


def test_what_gains_count_over_is_of_the_starts_of_runs_that_were_evaluated():
    make(returns=np.full((len(GRID), 5), 66.667), return_ceiling=200 / 3)  # as tables have it
    runs = [make(seed=i, returns=np.full((len(GRID), 5), 300.0)) for i in range(3)]
    early = make(seed=0, steps=NONE, returns=np.ones((0, 1)), failed_at=0)
    played = {"face_direction": {"random": [900.0, 0, 0, 0, 0]}}
    later = [replace(run, seed=run.seed + 1) for run in runs]
    ends = [replace(make(seed=i), final=np.full(5, 300.0)) for i in (1, 2)]
    for known in ([early, *later], [make(seed=0, steps=GRID[:5], failed_at=3500), *ends]):
        (group,) = analyse(known, references=played).groups
        assert group.references["random"].value == 180


def test_scalars_of_a_straight_line():
    grid = np.linspace(0, 1000, 101)
    curves = np.stack((grid / 2, np.full(101, 500.0)))
    np.testing.assert_allclose(mean_return(curves, grid), [250, 500])
    np.testing.assert_allclose(final_return(curves, grid), [475, 500])
    np.testing.assert_allclose(steps_to(curves, grid, 252.5), [505, 0])
    np.testing.assert_array_equal(steps_to(curves, grid, 501), [np.inf, np.inf])
    np.testing.assert_array_equal(steps_to(curves - 1000, grid, -747.5), [505, 0])
    assert np.isnan(steps_to(curves, grid, np.nan)).all()
    falling = np.array([[0.0, 100, 0, 200]])  # the first crossing counts
    assert steps_to(falling, np.array([0.0, 10, 20, 30]), 50).tolist() == [5]


def test_a_rise_is_that_of_the_last_fifth_above_the_one_before():
    """An evaluation at 80 % of training is of the fifth before."""
    grid = np.array([0.0, 500, 700, 800, 900, 1000])
    curves = np.array([[0.0, 9, 10, 20, 40, 50], [9, 9, 7, 7, 7, 7]])
    np.testing.assert_array_equal(rise(curves, grid), [45 - 15, 0])
    assert np.isnan(rise(curves[:, :3], grid[[0, 1, 5]])).all()  # none in the fifth before


def test_bands_are_those_of_whole_runs():
    random = np.random.default_rng(0)
    curves = random.normal(500, 20, (8, 1)) + random.normal(0, 5, (8, 150))
    found = bands(curves)
    np.testing.assert_allclose(found.p25, np.percentile(curves, 25, axis=0))
    np.testing.assert_allclose(found.iqm.value, stats.trim_mean(curves, 0.25, axis=0))
    for i in (0, 70, 149):  # the same resamples at each step
        np.testing.assert_allclose([p[i] for p in found.iqm], percentile(iqm, curves[:, i]))


def test_expected_shortfall_is_the_integral_of_the_quantiles():
    values = np.array([5.0, 1, 3, 2])
    assert expected_shortfall(values, 0.5) == 1.5
    assert expected_shortfall(values, 0.6) == pytest.approx((1 + 2 + 0.4 * 3) / 2.4)
    assert expected_shortfall(values, 0.01) == 1
    assert expected_shortfall(values, 1) == pytest.approx(values.mean())
    normal = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000)
    expected = -stats.norm.pdf(stats.norm.ppf(0.05)) / 0.05
    assert expected_shortfall(normal, 0.05) == pytest.approx(expected, abs=1e-3)


def test_bonett_by_hand():
    """Kurtosis about the median for five runs: sums of squares 10 and 40, of fourths 34, 544."""
    x = np.arange(1.0, 6)
    found = variance_ratio(2 * x, x)
    kurtosis = 10 * (544 + 34) / 50**2
    error = np.sqrt(2 * (kurtosis - 2 / 5) / 4)
    np.testing.assert_allclose(found, 4 * np.exp(np.array([0, -1.959964, 1.959964]) * error))
    kurtosis, correction = 5 * 34 / 10**2, 5 / (5 - 1.959964)
    half = 1.959964 * correction * np.sqrt((kurtosis - 2 / 5) / 4)
    expected = np.sqrt(2.5 * correction * np.exp([-half, half]))
    np.testing.assert_allclose(deviation(x), (np.sqrt(2.5), *expected), rtol=1e-6)


@pytest.mark.parametrize(("n", "scale"), [(5, 1), (20, 2)])
def test_intervals_of_two_groups_cover_the_truth(n, scale):
    """Differences within seeds, whose part of a return both sides share."""
    random = np.random.default_rng(n)
    for x, y in zip(shapes(n, random), shapes(n, random), strict=True):
        x = 480 + scale * (x - 500)
        shared = random.normal(0, 60, x.shape)
        for level, least, most in ((0.95, 0.92, 0.985), (0.996, 0.98, 1)):
            apart = mean_within((x + shared) - (y + shared), Bounds(), level)
            assert least <= covered(apart, -20) <= most
            assert least <= covered(variance_ratio(x, y, level), scale**2) <= most


def covered(found, truth):
    return np.mean((found.low <= truth) & (truth <= found.high))


def test_intervals_of_one_group_cover_the_truth():
    random = np.random.default_rng(5)
    for values in shapes(5, random, studies=300):
        found = [(mean(v), deviation(v)) for v in values]
        assert 0.88 <= np.mean([m.low <= 500 <= m.high for m, _ in found]) <= 0.98
        assert np.mean([sd.low <= 30 <= sd.high for _, sd in found]) >= 0.9


@pytest.mark.parametrize("together", [0, 40])
def test_a_share_of_a_gain_has_the_interval_of_its_paired_t_tests(together):
    """Fieller's, by looking for the shares that the test of each rejects at 5 %."""
    random = np.random.default_rng(3)
    x, y = random.normal(((450,), (500,)), 30, (2, 9)) + random.normal(0, together, 9)

    def room(share):
        return stats.ttest_1samp((x - 200) - share * (y - 200), 0).pvalue - 0.05

    value, low, high = share_of_gain(x, y, 200)
    assert value == pytest.approx((x.mean() - 200) / (y.mean() - 200))
    assert low == pytest.approx(optimize.brentq(room, value - 1, value))
    assert high == pytest.approx(optimize.brentq(room, value, value + 1))


def test_a_share_of_what_may_be_no_gain_is_unbounded_and_of_none_unknown():
    x, y = np.array([5.0, 7, 9]), np.array([-2.0, 1, 4])
    assert share_of_gain(x, y, 0) == (7, -np.inf, np.inf)
    assert np.isnan(share_of_gain(x, y, 1)).all()


def test_groups_without_variance_have_no_interval():
    still, other = np.full(5, 0.1), np.array([1.0, 2, 3, 4, 6])
    assert mean(still).tolist() == [pytest.approx(0.1), None, None]
    assert deviation(still).tolist()[1:] == [None, None]
    for pair in ((still, still), (still, other), (other, still)):
        assert variance_ratio(*pair).tolist()[1:] == [None, None]
    assert variance_ratio(other[:2], other[:2]).tolist()[1:] == [None, None]


def test_an_analysis_does_not_depend_on_the_order_of_runs(runs, analysis):
    mixed = [runs[i] for i in np.random.default_rng(0).permutation(len(runs))]
    assert to_plain(analyse(mixed)) == to_plain(analysis)


def test_an_analysis_is_judged_against_the_baseline(analysis):
    (group,) = analysis.groups
    assert [label.representation for label in group.labels] == ["full", "dae-8", "dae-4"]
    full, _, worse = group.labels
    middle = np.median(full.by_run["final_return"])
    assert group.thresholds["steps_to_90_percent"] == pytest.approx(0.9 * middle)
    assert worse.numbers["steps_to_90_percent"].tolist()[0] is None
    assert worse.numbers["reached_90_percent"].value == 0
    against = group.comparisons[1]
    assert against.numbers["probability_of_improvement"].value == 0
    expected = stats.levene(*(label.by_run["final_return"] for label in (full, group.labels[1])))
    assert group.comparisons[0].brown_forsythe_p == pytest.approx(expected.pvalue)


def test_groups_stay_apart():
    runs = study({"full": [500, 510, 520], "dae-8": [480, 520, 530]})
    other = [
        replace(run, algorithm="ppo", steps=run.steps[:5], returns=run.returns[:5]) for run in runs
    ]
    both = to_plain(analyse([*runs, *other]).groups)
    assert [group["algorithm"] for group in both] == ["ppo", "sac"]
    assert both[0]["grid"][-1] == 4000
    assert both[1]["labels"] == to_plain(analyse(runs).groups)[0]["labels"]


@pytest.fixture(scope="module")
def rliable():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        library = pytest.importorskip("rliable.library")
        return library, pytest.importorskip("rliable.metrics")


def test_results_across_tasks_are_rliable_s(rliable):
    library, metrics = rliable
    random = np.random.default_rng(0)
    scores = np.stack([random.normal(0.9, 0.1, 12), random.normal(0.6, 0.2, 12)])
    full = np.ones(10)
    one = {"full": full, "x": scores[0], "y": scores[0]}
    other = {"full": full, "x": np.append(scores[1], 9.0)}  # the 13th has no partner
    (_, found) = aggregates({"sac": {"one": one, "other": other}})
    np.random.seed(0)  # noqa: NPY002  rliable ignores its random_state
    values, intervals = library.get_interval_estimates(
        {"x": scores.T},
        lambda s: np.array([metrics.aggregate_iqm(s), metrics.aggregate_optimality_gap(s)]),
        reps=4000,
    )
    for i, ours in enumerate((found.iqm, found.optimality_gap)):
        assert ours.value == pytest.approx(values["x"][i])
        assert ours[1:] == pytest.approx(intervals["x"][:, i], abs=0.01)
    shares, _ = library.create_performance_profile({"x": scores.T}, found.scores, reps=10)
    np.testing.assert_allclose(found.profile.value, shares["x"])
    assert (found.runs, found.tasks) == (12, ("one", "other"))


def test_encoders_of_a_representation_have_a_variance_of_their_own():
    random = np.random.default_rng(1)
    of_encoder = random.normal(500, 60, 5)
    nested = [
        make("dae-8", seed, of_encoder[seed % 5] + random.normal(0, 5), encoder_seed=seed % 5)
        for seed in range(10)
    ]
    runs = [*study({"full": random.normal(500, 20, 10)}), *nested]
    (group,) = analyse(runs).groups
    numbers = group.labels[1].numbers
    assert group.labels[1].encoders == 5
    assert numbers["encoder_variance"].low > 10 * numbers["run_variance"].value
    expected = components(group.labels[1].by_run["final_return"].reshape(2, 5).T)
    assert numbers["encoder_variance"] == expected[0]
    (alone,) = analyse(runs[:-1]).groups  # unevenly nested
    assert np.isnan(alone.labels[1].numbers["run_variance"].value)
    assert np.isnan(group.labels[0].numbers["run_variance"].value)


def test_a_comparison_is_made_seed_by_seed_and_of_returns_and_scores():
    """Only of seeds that both have; what a seed draws is in neither difference."""
    drawn = np.random.default_rng(2).normal(0, 100, 8)
    levels = {"full": [*(500 + drawn), 100], "dae-8": 480 + drawn}
    scaled = {"reference": 100.0, "top": 900.0}
    (group,) = analyse([replace(run, **scaled) for run in study(levels)]).groups
    (found,) = group.comparisons
    full, other = (label.by_run["final_return"] for label in group.labels)
    difference = other - full[:8]
    expected = stats.ttest_1samp(difference, 0).confidence_interval()
    of_returns = (difference.mean(), *expected)
    assert found.numbers["final_return_difference"] == pytest.approx(of_returns)
    assert found.numbers["score_difference"] == pytest.approx(np.divide(of_returns, 800))
    expected = share_of_gain(other, full[:8], 100)
    assert found.numbers["share_of_gain"] == pytest.approx(expected)
    assert (found.shared, found.by_encoder) == (8, False)


@pytest.mark.parametrize("ends", ["of training", "of all starts"])
def test_a_score_is_0_without_looking_and_1_at_the_top_on_the_same_starts(ends):
    last = {"final": np.array([500.0, 700])} if ends == "of all starts" else {}
    scaled = {"reference": 100.0, "reference_in_training": 50.0}
    scaled |= {"top": 900.0, "top_in_training": 850.0}
    blind, top = (100, 900) if last else (50, 850)
    (group,) = analyse([make(seed=i, **scaled, **last) for i in range(2)]).groups
    (label,) = group.labels
    assert group.ends == (blind, 50, top)
    expected = (label.by_run["final_return"] - blind) / (top - blind)
    np.testing.assert_allclose(label.by_run["score"], expected)
    assert label.numbers["score"].value == pytest.approx(expected.mean())
    for unknown in (None, 40.0):  # a policy that returns less than one that doesn't look
        scaled |= {"top": unknown, "top_in_training": unknown}
        (group,) = analyse([make(seed=i, **scaled, **last) for i in range(2)]).groups
        assert np.isnan(group.labels[0].by_run["score"]).all()


@pytest.mark.parametrize("encoders", [7, 8])
def test_eight_encoders_are_the_units_of_intervals(encoders):
    """Of means and of differences; of fewer the runs are."""
    random = np.random.default_rng(5)
    count = 3 * encoders
    of_encoder = random.normal(450, 60, encoders)
    runs = [
        make("dae-8", i, of_encoder[i % encoders] + random.normal(0, 5), encoder_seed=i % encoders)
        for i in range(count)
    ]
    (group,) = analyse([*study({"full": random.normal(500, 20, count)}), *runs]).groups
    full, other = (label.by_run["final_return"] for label in group.labels)
    (found,) = group.comparisons
    units = (3, 8) if encoders == 8 else (1, count)
    means = other.reshape(units).mean(axis=0)
    expected = mean_within(means, Bounds(low=0), 0.95)
    assert group.labels[1].numbers["final_return_mean"] == pytest.approx(expected)
    expected = mean((other - full).reshape(units).mean(axis=0))
    assert found.numbers["final_return_difference"] == pytest.approx(expected)
    assert found.by_encoder == (encoders == 8)


def test_units_share_no_encoder_on_either_side():
    assert linked_units([[0, 0, 1, 2], [None] * 4]) == [[0, 1], [2], [3]]
    assert linked_units([[0, 0, 1, 2], [5, 6, 6, 7]]) == [[0, 1, 2], [3]]
    assert linked_units([[0, 1, 2, 3], [3, 0, 1, 2]]) == [[0], [1], [2], [3]]
    assert linked_units([[0, 1, 0, 2], [4, 5, 6, 5]]) == [[0, 2], [1, 3]]
    assert linked_units([[None] * 3, [None] * 3]) == [[0], [1], [2]]


def test_three_runs_are_points_and_no_interval_leaves_what_is_possible():
    few = analyse(study({"full": [500, 510, 990], "dae-8": [480, 520, 530]})).groups[0]
    for label in few.labels:
        assert all(np.isnan(each.low) for each in label.numbers.values())
        assert np.isnan(label.curve.iqm.low).all()
    assert np.isnan(few.comparisons[0].numbers["final_return_difference"].low)
    levels = {"full": [1000, 999, 998, 600, 1000], "dae-8": [1, 0, 2, 400, 1]}
    runs = [replace(run, return_ceiling=1000.0) for run in study(levels)]
    (group,) = analyse(runs).groups
    for label in group.labels:
        for by in ("final_return_mean", "mean_return_mean"):
            _, low, high = label.numbers[by]
            assert 0 < low < high < 1000
        assert label.numbers["final_return_sd"].low > 0


@pytest.mark.parametrize("ties", [False, True])
def test_the_correlation_of_ranks_is_spearman_s(ties):
    x, noise = np.random.default_rng(0).normal(size=(2, 12))
    y = x + noise
    if ties:
        x, y = x.round(), y.round()
    codes = [*"abcdefghijkl"]
    value, low, high = rank_correlation(x, y, codes)
    assert value == pytest.approx(stats.spearmanr(x, y).statistic)
    assert -1 <= low < value < high <= 1
    assert rank_correlation(x, y, codes) == rank_correlation(np.exp(x), 3 * y, codes)  # ranks alone
    assert rank_correlation(-x, y, codes).value == pytest.approx(-value)


def test_families_of_codes_are_resampled_as_a_whole():
    """Each code twice says as much as each code once; drawn one by one, twice as much."""
    x, noise = np.random.default_rng(0).normal(size=(2, 8))
    once = rank_correlation(x, x + noise, [*"abcdefgh"])
    twice = np.repeat((x, x + noise), 2, axis=1)
    assert rank_correlation(*twice, [*"aabbccddeeffgghh"]) == pytest.approx(once)
    _, low, high = rank_correlation(*twice, [*"abcdefghijklmnop"])
    assert high - low < 0.8 * (once.high - once.low)
    assert np.isnan(rank_correlation(*twice, [*"aaaabbbbccccdddd"]).low)


def test_few_pairs_and_constant_values_say_nothing():
    x = np.arange(5.0)
    assert np.isnan(rank_correlation(x[:4], x[:4], [*"abcd"])).all()
    assert np.isnan(rank_correlation(x, np.ones(5), [*"abcde"])).all()
    assert rank_correlation(x, x, [*"abcde"]).value == 1
