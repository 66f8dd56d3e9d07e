"""Figures say what their tables say, and tables what the statistics say."""

import csv
import io
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from jbrep.report.figures.curves import every_run
from jbrep.report.figures.diagnostics import _free
from jbrep.report.figures.differences import difference_plot
from jbrep.report.figures.methods import method_plots, timescales
from jbrep.report.figures.plot import Drawing
from jbrep.report.figures.style import COLUMN, DARK, PAGE, PAPER, family, styles, with_runs
from judged import NOTHING, diagnostics, evaluation, prediction
from made_up import drawn, label_of, returns_of
from matplotlib.text import Text
from PIL import Image

from jbrep.envs import describe
from jbrep.evaluate.evaluation import (
    KEPT,
    Evaluation,
    FeatureError,
    Prediction,
    Reconstruction,
    Score,
)
from jbrep.records.document import read_document
from jbrep.report.figures import encoder_plots, study_plots, write
from jbrep.stats import RunCurve, analyse
from jbrep.stats.association import Diagnostic, associations
from jbrep.stats.bootstrap import Interval
from jbrep.stats.rules import Verdict

STEPS = np.arange(0, 50_001, 10_000)
FINAL = {"full": 900, "dae-8": 500, "pca-4": 300}
GROUPS = [("face_direction", "ddpg"), ("face_direction", "sac"), ("move_to_pose", "sac")]
DAE = label_of(
    describe("face_direction"),
    "dae-8",
    [(128, "relu"), (8, "tanh")],
    [(128, "relu"), (16, "linear")],
    noise=0.1,
)
LABELS = {"face_direction/sac/dae-8": DAE}


def runs():
    """Four runs of each, three of dae-8 on the last."""
    random = np.random.default_rng(0)
    for task, algorithm in GROUPS:
        for label, final in FINAL.items():
            for seed in range(3 if (task, label) == ("move_to_pose", "dae-8") else 4):
                end = final + random.normal(0, 20)
                returns = np.linspace(100, end, len(STEPS))[:, None] + random.normal(0, 5, (6, 3))
                yield RunCurve(
                    *(task, algorithm, label, seed, "s", STEPS, returns.clip(0, 1000)),
                    total_steps=50_000,
                    return_floor=0,
                    reference=0,
                    top=950,
                    solved=900,
                    failed_at=30_000 if (label, seed) == ("pca-4", 3) else None,
                )


@pytest.fixture(scope="module")
def analysis():
    return analyse(list(runs()))


@pytest.fixture(scope="module")
def returns():
    return returns_of(runs())


@pytest.fixture(scope="module")
def plots(analysis, returns):
    played = {"face_direction": {"hand-written": [910, 950, 990]}}
    return {plot.name: plot for plot in study_plots(analysis, returns, played, LABELS)}


def panels(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def test_a_study_has_every_figure(plots):
    assert list(plots) == [
        *("final_return", "representations", "differences", "learning_rate", "profiles"),
        *("across_tasks", "every_run", "system", "autoencoders"),
    ]


def test_each_figure_is_written_as_pdf_and_png_beside_its_table(analysis, returns, tmp_path):
    one = replace(analysis, groups=analysis.groups[:1])
    some = [row for row in returns if row[:2] == GROUPS[0]]
    plots = {plot.name: plot for plot in study_plots(one, some, {}, LABELS)}
    pictures = write(plots.values(), tmp_path / "figures")
    assert [path.stem for path in pictures] == list(plots)
    for path, plot in zip(pictures, plots.values(), strict=True):
        width = Image.open(io.BytesIO(path.read_bytes())).size[0] / PAPER["savefig.dpi"]
        assert width == pytest.approx(COLUMN, abs=0.01) or width == pytest.approx(PAGE, abs=0.01)
        assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        header, *rows = csv.reader(path.with_suffix(".csv").read_text().splitlines())
        assert header == list(plot.columns)
        assert len(rows) == len(plot.rows) > 0
    write([plots["differences"]], tmp_path / "again")
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (tmp_path / "figures" / path.name).read_bytes()


def test_curves_are_the_medians_of_the_statistics(plots, analysis):
    group = analysis.groups[1]
    assert (group.task, group.algorithm) == GROUPS[1]
    axes = panels(drawn(plots["representations"]))["face_direction, sac"]
    lines = {line.get_label().split(" (")[0]: line for line in axes.lines}
    for label in group.labels:
        np.testing.assert_array_equal(lines[label.representation].get_ydata(), label.curve.p50)
    assert set(lines["hand-written"].get_ydata()) == {950}
    assert any(set(line.get_ydata()) == {900} for line in axes.lines)
    bands = [path.get_paths()[0].get_extents() for path in axes.collections]
    assert bands[0].y1 == pytest.approx(max(group.labels[0].curve.p90))


def test_policies_stand_beside_curves_of_the_same_starts_alone(plots, analysis, returns):
    """Of more starts than the curves have, they would be other numbers."""
    assert "Dashed: policies that don't learn" in plots["representations"].caption
    played = {"face_direction": {"hand-written": [910, 950, 990, 1000]}}
    told = {plot.name: plot for plot in study_plots(analysis, returns, played, {})}
    for name in ("representations", "learning_rate"):  # both of evaluations during training
        assert "Dashed" in plots[name].caption
        assert "Dashed" not in told[name].caption
        lines = (line for axes in drawn(told[name]).axes for line in axes.lines)
        assert not any(line.get_label() == "hand-written" for line in lines)


def test_the_grid_has_tasks_by_algorithms(plots):
    figure = drawn(plots["representations"])
    shown = {title for title, axes in panels(figure).items() if axes.axison}
    assert shown == {", ".join(group) for group in GROUPS}


def test_legends_say_how_many_runs_there_are(plots):
    for name in ("representations", "profiles"):
        (legend,) = drawn(plots[name]).legends
        texts = {text.get_text() for text in legend.get_texts()}
        assert {"full (n = 4)", "dae-8 (n = 3\N{EN DASH}4)", "solved"} <= texts
    for name in ("final_return", "learning_rate"):
        *_, last = (axes for axes in drawn(plots[name]).axes if axes.axison)
        texts = [text.get_text() for text in last.get_xticklabels()]
        assert texts == ["full (n = 4)", "dae-8 (n = 3)", "pca-4 (n = 4)"]
    titles = [axes.get_title(loc="left") for axes in drawn(plots["every_run"]).axes]
    assert titles[-2:] == ["dae-8 (n = 3)", "pca-4 (n = 4)"]
    assert with_runs("$a", [5, 3, 4]) == "\\$a (n = 3\N{EN DASH}5)"


def test_a_representation_has_one_colour_in_all_figures(analysis, returns):
    """Also where the statistics leave out a representation that comes before it."""
    kept = [run for run in runs() if run.representation != "dae-8"]
    of_part = study_plots(analyse(kept), returns, {}, {})
    of_all = study_plots(analysis, returns, {}, LABELS)
    for plots in (of_part, of_all):
        colours = set()
        for plot in plots:
            for axes in drawn(plot).axes:
                colours |= {
                    line.get_color()
                    for line in axes.lines
                    if line.get_label().startswith("pca-4")
                    or (plot.name == "every_run" and "pca-4" in axes.get_title(loc="left"))
                }
        assert colours == {"#D55E00"}
    latent = drawn(of_all[-1]).axes[0].lines[2]  # observation, hidden layer, latent
    assert latent.get_color() == "#0072B2"


def of_first_group(name):
    key = (*GROUPS[0], name)
    return [run for run in runs() if (run.task, run.algorithm, run.representation) == key]


def check_apart(figure, words, count):
    """Check that so many texts with these words don't overlap."""
    boxes = [t.get_window_extent() for t in figure.findobj(Text) if words in t.get_text()]
    assert len(boxes) == count
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))


def test_titles_of_many_representations_do_not_overlap(returns):
    names = [f"representation-{number}" for number in range(7)]
    full = [row for row in returns if row[:3] == (*GROUPS[0], "full")]
    rows = [row._replace(representation=name) for name in names for row in full]
    figure = every_run(rows, {}, lambda: styles(names)).on_paper._figure
    check_apart(figure, "(n = 4)", len(names))


@pytest.mark.parametrize(("word", "tilted"), [("dae-{}", False), ("forward-{}-symmetry", True)])
def test_names_of_representations_do_not_run_into_each_other(word, tilted):
    full = of_first_group("full")
    names = ["full", word.format(8), word.format(4)]
    three = [replace(run, representation=name) for name in names for run in full]
    (returned,) = (p for p in study_plots(analyse(three), [], {}, {}) if p.name == "final_return")
    figure = returned.on_paper._figure
    labels = [text for text in figure.axes[0].get_xticklabels() if text.get_text()]
    assert {text.get_rotation() for text in labels} == {30.0 if tilted else 0.0}
    if not tilted:
        boxes = [text.get_window_extent() for text in labels]
        assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))


def test_titles_of_many_algorithms_do_not_overlap():
    full = of_first_group("full")
    many = [replace(run, algorithm=f"algorithm-{number}") for number in range(6) for run in full]
    (curves,) = (p for p in study_plots(analyse(many), [], {}, {}) if p.name == "representations")
    figure = curves.on_paper._figure
    check_apart(figure, "algorithm-", 6)


def test_a_study_of_many_representations_can_be_read():
    """Legends don't take the room of panels, and no two lines look alike."""
    full, other = of_first_group("full"), of_first_group("dae-8")
    names = [f"another-one-{number}" for number in range(15)]
    many = [replace(run, representation=name) for name in names for run in other]
    plots = study_plots(analyse(full + many), [], {}, {})
    for plot in plots:
        if plot.name in ("representations", "profiles", "learning_rate", "differences"):
            figure = Drawing(plot.draw, PAPER)._figure
            heights = [axes.get_window_extent().height / figure.dpi for axes in figure.axes]
            assert min(heights) > 0.8, plot.name
    colours = {style["color"] for style in styles(["full", *names], "full").values()}
    assert len(colours) == 16


def test_every_run_is_drawn(plots, returns):
    axes = drawn(plots["every_run"]).axes[0]
    assert len(axes.lines) == 1 + 4 + 1  # a policy, the runs and their median
    (first,) = [row for row in plots["every_run"].rows if row[:5] == (*GROUPS[0], "full", 0, 0)]
    episodes = [r.episode_return for r in returns if r[:5] == first[:5]]
    assert float(first[5]) == pytest.approx(np.mean(episodes), abs=1e-3)


def test_a_point_for_each_run_and_an_interval_for_each_label(plots, analysis):
    labels = analysis.groups[0].labels
    axes = drawn(plots["final_return"]).axes[0]
    points = [line for line in axes.lines if line.get_marker() == "."]
    for line, label in zip(points, labels, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), label.by_run["final_return"])
    means = [bar.lines[0].get_ydata()[0] for bar in axes.containers]
    assert means == [label.numbers["final_return_mean"].value for label in labels]
    segments = axes.containers[0].lines[2][0].get_segments()[0]
    np.testing.assert_allclose(segments[:, 1], labels[0].numbers["final_return_mean"][1:])


def with_interval(analysis, name, interval):
    """The first group alone, its baseline with an interval that is given."""
    (baseline, *others) = analysis.groups[0].labels
    changed = replace(baseline, numbers={**baseline.numbers, name: Interval(*interval)})
    group = replace(analysis.groups[0], labels=(changed, *others))
    return replace(analysis, groups=(group,))


def cut_marks(axes, markers):
    return [
        (line.get_xdata()[0], line.get_ydata()[0], line.get_marker())
        for line in axes.lines
        if line.get_marker() in markers and not line.get_clip_on()
    ]


def test_no_interval_stretches_an_axis_and_cuts_are_marked(analysis):
    wide = with_interval(analysis, "final_return_sd", (40, 2, 5000))
    left, right = drawn(study_plots(wide, [], {}, {})[0]).axes
    _, high = right.get_ylim()
    low, top = left.get_ylim()
    assert high == pytest.approx(1.04 * (top - low) / 1.08 / 2)  # the SD of two far apart
    assert (0, high, "^") in cut_marks(right, "^v")
    largest = max(max(label.by_run["final_return"]) for label in wide.groups[0].labels)
    wide = with_interval(analysis, "final_return_mean", (500, -900, 1900))
    left, _ = drawn(study_plots(wide, [], {}, {})[0]).axes
    low, high = left.get_ylim()
    assert (low, high) == pytest.approx((-0.05 * largest, 1.3 * largest))  # not below the floor
    assert cut_marks(left, "^v") == [(0.16, low, "v"), (0.16, high, "^")]
    wide = with_interval(analysis, "mean_return_mean", (500, 400, 1900))
    (axes,) = drawn(study_plots(wide, [], {}, {})[3]).axes
    largest = max(max(label.by_run["mean_return"]) for label in wide.groups[0].labels)
    assert axes.get_ylim()[1] == pytest.approx(1.3 * largest)
    assert cut_marks(axes, "^v") == [(0.16, axes.get_ylim()[1], "^")]


def difference_panel(group, analysis):
    """The panel of the first group, which is given."""
    changed = replace(analysis, groups=(group, *analysis.groups[1:]))
    plot = difference_plot(changed, lambda: styles(FINAL))
    return drawn(plot).axes[0], plot.rows


def test_differences_from_the_baseline_stand_with_their_intervals(analysis):
    group = analysis.groups[0]
    axes, rows = difference_panel(group, analysis)
    tested, thick, point, boundary = axes.lines[:4]
    value, *ends = group.comparisons[0].numbers["final_return_difference"]
    assert np.isnan(tested.get_xdata()).all()
    np.testing.assert_array_equal(thick.get_xdata(), ends)
    assert point.get_xdata()[0] == value
    assert {*boundary.get_xdata()} == {0}
    assert axes.get_title(loc="left") == "face_direction, ddpg"
    texts = [text.get_text() for text in axes.get_yticklabels()]
    assert texts == ["dae-8 - full", "pca-4 - full"]
    assert rows[0][2:6] == ("dae-8", "full", "", "")


def test_claims_stand_in_their_place_with_boundaries_and_what_was_tested(analysis):
    of_returns = {"task": "face_direction", "algorithm": "ddpg", "x": "dae-8", "y": "pca-4"}
    verdict = Verdict(
        **of_returns,
        **{"claim": "not worse", "verdict": "supported", "boundary": -90.0},
        estimate=Interval(200.0, 150.0, 250.0),
        interval=Interval(200.0, 145.0, 255.0),
    )
    faster = replace(verdict, claim="faster", estimate=Interval(-1e4, -2e4, 0.0))
    axes, rows = difference_panel(replace(analysis.groups[0], verdicts=(verdict, faster)), analysis)
    tested, thick, _, boundary = axes.lines
    assert [[*line.get_xdata()] for line in (tested, thick)] == [[145, 255], [150, 250]]
    assert boundary.get_xdata()[0] == -90 > axes.get_xlim()[0]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["dae-8 not worse than pca-4"]
    assert rows[0][2:6] == ("dae-8", "pca-4", "not worse", "supported")


def test_an_interval_far_beyond_or_without_an_end_is_drawn_to_the_edge(analysis):
    (group, *_), far = analysis.groups, Interval(100.0, -1e9, np.inf)
    numbers = group.comparisons[0].numbers | {"final_return_difference": far}
    comparisons = (replace(group.comparisons[0], numbers=numbers), *group.comparisons[1:])
    axes, _ = difference_panel(replace(group, comparisons=comparisons), analysis)
    left, right = axes.get_xlim()
    assert -2000 < left < right < 2000
    assert [*axes.lines[1].get_xdata()] == [left, right]
    assert {(left, 0, "<"), (right, 0, ">")} == {*cut_marks(axes, "<>")}


def test_a_profile_falls_from_all_runs_to_none(analysis):
    group = analysis.groups[0]
    label = group.labels[0]
    share = label.profile.value
    assert share[0] == 1
    assert share[-1] == 0
    at = group.profile_returns.tolist().index(900)
    assert share[at] == (label.by_run["final_return"] > 900).mean()
    assert np.all(np.diff(share) <= 0)


def test_profiles_across_tasks_are_those_of_the_statistics(plots, analysis):
    (axes,) = drawn(plots["across_tasks"]).axes
    assert axes.get_title(loc="left") == "sac, 2 tasks"
    _, *steps = [line for line in axes.lines if len(line.get_xdata()) == 2 or line.get_label()]
    for line, each in zip(steps, analysis.aggregates, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), each.profile.value)
    assert steps[1].get_label() == "dae-8 (n = 3)"


def test_without_statistics_the_runs_are_drawn_all_the_same(returns):
    names = [plot.name for plot in study_plots(None, returns, {}, {})]
    assert names == ["every_run"]
    assert study_plots(None, [], {}, {}) == []  # all failed before their first evaluation


def test_diagrams_have_the_real_sizes(plots):
    texts = [text.get_text() for text in drawn(plots["autoencoders"]).axes[0].texts]
    assert {"16 scaled", "128 relu", "8 tanh", "16 linear"} <= set(texts)
    assert ("agent", "SAC, hidden 350-250") in plots["system"].rows


def test_diagrams_show_what_any_method_does():
    slow = label_of(
        *(describe("face_direction"), "slow", [(8, "linear")], [(17, "linear")], "slow", 9),
        **{"latent": 8, "lags": [10], "scaling": "standard", "on": "angles"},
        keep=["angle_to_target"],
    )
    diagrams = study_plots(None, [], {}, {"x": slow})
    of_system, of_layers = (plot.rows for plot in diagrams)
    assert ("observation", "16 features, angles, standard scaling") in of_system
    assert ("latent", "9 numbers") in of_system  # eight and the one that passes around
    assert of_layers[0] == ("slow", "encoder", 0, 8, "linear")
    one = label_of(describe("face_direction"), "pca-1", [(1, "linear")], [(16, "linear")], "pca")
    assert ("latent", "1 number") in study_plots(None, [], {}, {"x": one})[0].rows
    (axes,) = drawn(diagrams[1]).axes
    assert axes.get_title(loc="center") == "slow\nangle_to_target passed around"


def test_pages_have_a_light_and_a_dark_style(plots):
    plot = plots["differences"]
    light, dark = plot.on_paper.picture("svg"), Drawing(plot.draw, DARK).picture("svg")
    assert b"#dddddd" in dark.lower()
    assert b"#dddddd" not in light.lower()
    assert Drawing(plot.draw, DARK).picture("svg") == dark


def test_policies_with_dollar_signs_are_no_formulas(analysis, returns):
    odd = {"$x^{$": Interval(300.0, 290.0, 310.0)}
    groups = tuple(replace(group, references=odd) for group in analysis.groups)
    changed = replace(analysis, groups=groups)
    played = {"face_direction": {"$x^{$": [300.0]}}
    for plot in study_plots(changed, returns, played, {})[:5]:
        drawn(plot).canvas.draw()


def test_names_with_dollar_signs_are_no_formulas(returns):
    odd = [row._replace(representation="$x^{") for row in returns]
    (plot, *_) = study_plots(None, odd, {}, {})
    assert Image.open(io.BytesIO(Drawing(plot.draw, PAPER).picture("png"))).size[0] > 0


def test_figures_of_encoders_come_from_their_evaluation(tmp_path):
    whole = read_document(Path("results/encoders/face_direction/evaluation.json"), Evaluation)
    encoders = {name: whole.encoders[name] for name in ("full", "dae-12", "dae-8", "pca-8")}
    found = {plot.name: plot for plot in encoder_plots(whole.replace(encoders=encoders))}
    assert list(found) == [
        *("prediction_by_feature", "prediction_by_horizon", "error_by_feature", "error_by_latent"),
    ]
    error = encoders["dae-8"].reconstruction.mse
    (row,) = [row for row in found["error_by_latent"].rows if row[0] == "dae-8"]
    assert row[2:5] == error
    axes = drawn(found["error_by_latent"]).axes[0]
    assert any(error.value in container.lines[0].get_ydata() for container in axes.containers)
    assert axes.lines[-1].get_label() == "PCA"
    assert axes.lines[-1].get_marker() == "o"  # as a line, one size alone couldn't be seen
    assert len(write(found.values(), tmp_path)) == 4


def test_of_a_wide_robot_the_worst_features_are_shown():
    """Humanoid's 348 would make a figure of 14,000 pixels, with names that nobody can read."""
    r2 = [*(Score(1 - i / 348, None, None) for i in range(347)), NOTHING]  # the last is constant
    features = [
        FeatureError(name=f"obs_{i}", unit="", mse=NOTHING, rmse_physical=NOTHING, r2=each)
        for i, each in enumerate(r2)
    ]
    loses = {"mse": NOTHING, "pca_mse": NOTHING, "ratio_to_pca": None, "features": features}
    lost = Reconstruction(**loses)
    encoders = {
        name: diagnostics(348, kind=kind, reconstruction=lost)
        for name, kind in (("dae-348", "dae"), ("raw", "full"))
    }
    (by_feature,) = encoder_plots(evaluation(encoders, "Humanoid-v5"))
    assert len(by_feature.rows) == 2 * 348
    assert "Of 348 features the 40 worst are shown; all are in the table." in by_feature.caption
    figure = drawn(by_feature)
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == [f"obs_{i}" for i in range(307, 347)]
    assert "the 40 worst of 348 features" in figure.get_suptitle()
    assert figure.get_figheight() < 8


def test_diagnostics_stand_against_final_returns(analysis, returns):
    """Of every code that has them; a correlation only where there are enough codes."""
    known = {
        ("face_direction", "full"): {"forward": 0.9, "error": 0.0},
        ("face_direction", "dae-8"): {"forward": 0.5, "error": None},
        ("face_direction", "pca-4"): {"forward": 0.2, "error": 0.3},
        ("face_direction", "pca-2"): {"forward": 0.1, "error": 0.4},  # without runs
    }
    which = Diagnostic("forward", "of changes", 1), Diagnostic("error", "of the state", -1)
    kinds = {code: code[1].partition("-")[0] for code in known}
    found = associations(analysis.groups, known, which, kinds)
    assert [(each.group.algorithm, each.diagnostic.name, len(each.values)) for each in found] == [
        *(("ddpg", "forward", 3), ("ddpg", "error", 2)),
        *(("sac", "forward", 3), ("sac", "error", 2)),
    ]
    assert np.isnan(found[0].correlation.value)
    (plot,) = [p for p in study_plots(analysis, [], {}, {}, found) if p.name == "diagnostics"]
    final = analysis.groups[0].labels[1].numbers["final_return_mean"].value
    row = ("face_direction", "ddpg", "forward", "dae-8", "0.5", f"{final:.7g}", "", "", "", 3, 3)
    assert plot.rows[1] == row
    forward, error, *_ = drawn(plot).axes  # no panel of correlations, as there are none
    assert forward.lines[1].get_xydata().tolist() == [[0.5, final]]
    assert error.get_xlim()[0] > error.get_xlim()[1]  # the better ones to the right


def test_names_stand_where_they_cover_nothing():
    places = _free(("a", "b", "c"), np.array([[0.5, 0.5], [0.56, 0.5], [0.53, 0.52]]))
    assert places[0][0] < 0 < places[1][0]  # a to the left of its point, b to the right
    crowd = np.full((5, 2), 0.5)
    assert None in _free(["a-long-name"] * 5, crowd)


def scores(quality):
    """How well an encoder predicts, by the steps ahead."""
    three = Score(quality, quality - 0.02, quality + 0.02)
    known = {"features": {"yaw": three, "still": NOTHING}, "mean": three}
    reward = Score(quality / 2, None, None)
    return {steps: Prediction(**known, reward=reward, rewarded=None) for steps in ("1", "5", "20")}


@pytest.fixture(scope="module")
def of_methods():
    """The figures of an evaluation of methods that say something of themselves, by name."""
    spectrum = [0.9, 0.8, 0.1, -0.01]
    spectra = {"10": spectrum, "2": [0.99, 0.95, 0.4, 0.2]}
    slow = {"spectrum": spectrum, "spectra": spectra}
    losses = {"train_loss": 0.2, "test_loss": 0.3}
    parts = {"1": {"changes": 0.4, "reward": 0.1}, "20": {"changes": 0.9, "reward": 1.8}}
    methods = {
        "full": ("full", 4, 0.9, {}),
        "slow-2": ("slow", 2, 0.8, slow),
        "slow-1": ("slow", 1, 0.1, slow),
        "forward-2-s1": ("forward", 2, 0.7, {**losses, "loss_by_horizon": parts}),
    }
    encoders = {
        label: diagnostics(latent, kind=kind, method=method, prediction=scores(quality))
        for label, (kind, latent, quality, method) in methods.items()
    }
    return {plot.name: plot for plot in encoder_plots(evaluation(encoders))}


def test_methods_and_predictions_have_figures(of_methods):
    assert list(of_methods) == [
        *("prediction_by_feature", "prediction_by_horizon"),
        *("spectrum", "timescales", "loss_by_horizon", "losses"),
    ]


def test_predictions_stand_by_feature_and_encoder(of_methods):
    plot = of_methods["prediction_by_feature"]
    assert "5 steps" in plot.caption  # there are none of 10
    assert ("slow-2", 20, "yaw", 0.8, 0.78, 0.8200000000000001) in plot.rows
    axes = drawn(plot).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        *("yaw", "still", "mean of features", "reward")
    ]
    expected = [[0.9, 0.8, 0.1, 0.7], [np.nan] * 4, [0.9, 0.8, 0.1, 0.7], [0.45, 0.4, 0.05, 0.35]]
    np.testing.assert_array_equal(axes.images[0].get_array(), expected)
    by_horizon = drawn(of_methods["prediction_by_horizon"]).axes[0]
    low, high = by_horizon.get_ylim()
    assert low < 0.1 < 0.9 < high  # no encoder is cut off


def test_an_interval_far_below_nothing_leaves_predictions_readable():
    wild = prediction(0.2, reward=Score(0.1, -138.0, 0.3))
    plots = encoder_plots(evaluation({"full": diagnostics(prediction={"1": wild})}))
    axes = drawn({plot.name: plot for plot in plots}["prediction_by_horizon"]).axes[0]
    assert axes.get_ylim() == (-0.1, 1.03)


def test_a_spectrum_shows_which_units_a_code_keeps(of_methods):
    axes = drawn(of_methods["spectrum"]).axes[0]
    line, *rings = axes.lines  # one line of both, as their spectra are the same
    assert list(line.get_ydata()) == [0.9, 0.8, 0.1, -0.01]
    assert [tuple(ring.get_xydata()[0]) for ring in rings] == [(2, 0.8), (1, 0.9)]


def test_features_that_pass_around_the_layers_are_no_units():
    method = {"spectrum": [0.9, 0.8, 0.1], KEPT: 2}
    beside = {"slow-1": diagnostics(3, kind="slow", method=method)}
    plots = {plot.name: plot for plot in encoder_plots(evaluation(beside))}
    _, ring = drawn(plots["spectrum"]).axes[0].lines
    assert tuple(ring.get_xydata()[0]) == (1, 0.9)


def test_timescales_are_those_of_an_exponential_decay(of_methods):
    lags = np.array([2, 5, 10])
    steps = [timescales(np.exp(-lag / np.array([30.0, 4.0])), lag) for lag in lags]
    np.testing.assert_allclose(steps, [[30, 4]] * 3)
    assert np.isnan(timescales(np.array([1.01, 0, -0.2]), 5)).all()
    rows = [row for row in of_methods["timescales"].rows if row[:3] == ("slow-2", 10, 1)]
    assert float(rows[0][4]) == pytest.approx(-10 / np.log(0.9), rel=1e-5)
    (axes,) = drawn(of_methods["timescales"]).axes
    assert list(axes.lines[0].get_xdata()) == [2, 10]  # in order, whatever that of the file


def test_losses_of_training_stand_by_horizon_and_part(of_methods):
    changes, reward = drawn(of_methods["loss_by_horizon"]).axes
    assert list(changes.lines[1].get_ydata()) == [0.4, 0.9]
    assert list(reward.lines[1].get_ydata()) == [0.1, 1.8]
    assert reward.get_ylim()[1] > 1.8  # on the axis that both share
    assert of_methods["losses"].rows == [("forward-2-s1", 0.2, 0.3)]
    (axes,) = drawn(of_methods["losses"]).axes
    assert axes.get_xscale() == "linear"  # a logarithmic one would have labels on each other


def test_losses_stand_by_term_and_divergences_by_unit():
    methods = {
        "deepmdp-8": {"loss_by_term": {"reward": 0.3, "transition": 0.01}},
        "vae-2": {"divergence": [0.1, 2.0]},
    }
    terms, units = method_plots("x", {n: diagnostics(2, method=m) for n, m in methods.items()})
    assert terms.rows == [("deepmdp-8", "reward", 0.3), ("deepmdp-8", "transition", 0.01)]
    assert units.rows == [("vae-2", "1", 2.0), ("vae-2", "2", 0.1)]
    (line,) = drawn(units).axes[0].lines
    assert list(line.get_ydata()) == [2.0, 0.1]
    (points,) = drawn(terms, DARK).axes[0].lines
    assert (points.get_linestyle(), points.get_color()) == ("None", "#56B4E9")  # of the style


def test_families_differ_in_size_only():
    assert [family(*each) for each in (("dae-8", 8), ("dae-8-s2", 8), ("slow-20", 8))] == [
        *("dae", "dae-s2", "slow-20")
    ]
