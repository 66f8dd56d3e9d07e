"""Figures say what their tables say, and tables what the statistics say."""

import csv
import io

import numpy as np
import pytest
from judged import NOTHING
from made_up import drawn, found_of
from PIL import Image

from jbrep.reporting.figures import study_plots, write
from jbrep.reporting.figures.panels import COLUMN, PAGE, PAPER
from jbrep.stats.analysis import analyse
from jbrep.stats.runs import RunCurve

STEPS = np.arange(0, 50_001, 10_000)
FINAL = {"full": 900, "dae-8": 500, "pca-4": 300}
PLAYED = {"face_direction": {"scripted": [910.0, 950.0, 990.0]}}
IN_TRAINING = {"face_direction": {"scripted": 950.0}}
FACTS = {"total_steps": 50_000, "return_floor": 0, "reference": 0, "top": 950, "solved": 900}
GROUPS = [("face_direction", "ddpg"), ("face_direction", "sac"), ("move_to_pose", "sac")]


def runs():
    """Four runs of each, three of dae-8 on the last."""
    random = np.random.default_rng(0)
    for task, algorithm in GROUPS:
        for label, final in FINAL.items():
            for seed in range(3 if (task, label) == ("move_to_pose", "dae-8") else 4):
                end = final + random.normal(0, 20)
                returns = np.linspace(100, end, len(STEPS))[:, None] + random.normal(0, 5, (6, 3))
                failed_at = 30_000 if (label, seed) == ("pca-4", 3) else None
                given = (task, algorithm, label, seed, "s", STEPS, returns.clip(0, 1000))
                yield RunCurve(*given, failed_at=failed_at, **FACTS)


@pytest.fixture(scope="module")
def found():
    return found_of(analyse(list(runs()), references=PLAYED), runs(), IN_TRAINING)


@pytest.fixture(scope="module")
def plots(found):
    return {plot.name: plot for plot in study_plots(found)}


def test_each_figure_is_written_as_pdf_and_png_beside_its_table(found, tmp_path):
    one = found.replace(groups=found.groups[:1], aggregates=[], runs=found.runs[:4])
    plots = {plot.name: plot for plot in study_plots(one)}
    write(plots.values(), tmp_path / "figures")
    pictures = [tmp_path / "figures" / f"{name}.png" for name in plots]
    for path, plot in zip(pictures, plots.values(), strict=True):
        width = Image.open(io.BytesIO(path.read_bytes())).size[0] / PAPER["savefig.dpi"]
        assert width == pytest.approx(COLUMN, abs=0.01) or width == pytest.approx(PAGE, abs=0.01)
        assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        header, *rows = csv.reader(path.with_suffix(".csv").read_text().splitlines())
        assert header == list(plot.rows[0])
        assert len(rows) == len(plot.rows) > 0
    (again,) = [plot for plot in study_plots(one) if plot.name == "differences"]
    write([again], tmp_path / "again")
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (tmp_path / "figures" / path.name).read_bytes()


def test_curves_are_the_means_of_the_statistics(plots, found):
    group = found.groups[1]
    assert (group.task, group.algorithm) == GROUPS[1]
    panels = {axes.get_title(loc="left"): axes for axes in drawn(plots["representations"]).axes}
    axes = panels["face_direction,\nsac"]
    lines = {line.get_label(): line for line in axes.lines}
    curves = [line.get_ydata() for line in axes.lines if len(line.get_xdata()) > 2]
    for agents, curve in zip(group.agents, curves, strict=False):
        np.testing.assert_array_equal(curve, agents.curve["mean"])
    assert [text.get_text() for text in axes.texts] == [a.representation for a in group.agents]
    assert set(lines["scripted"].get_ydata()) == {950}
    assert set(lines["solved"].get_ydata()) == {900}
    bands = [path.get_paths()[0].get_extents() for path in axes.collections]
    assert bands[0].y1 == pytest.approx(max(group.agents[0].curve["p90"]))


def test_differences_from_the_baseline_stand_with_their_intervals(found):
    (plot,) = [plot for plot in study_plots(found) if plot.name == "differences"]
    axes, rows = drawn(plot).axes[0], plot.rows
    value, *ends = found.groups[0].comparisons[0].numbers["final_return_difference"]
    assert (rows[0]["difference"], rows[0]["tested_low"]) == (value, None)
    (thick,) = [line for line in axes.lines if line.get_linewidth() == 2][:1]
    np.testing.assert_array_equal(thick.get_xdata(), ends)
    texts = [text.get_text() for text in axes.get_yticklabels()]
    assert texts == ["dae-8 - full", "pca-4 - full"]


def test_diagnostics_stand_against_final_returns(found):
    """Of every code that has them, whichever are registered; better ones to the right."""
    of_all = {"task": "face_direction", "algorithm": "ddpg", "correlation": NOTHING}
    codes = {"final_returns": [900.0, 500.0], "families": ["full", "dae"]}
    told = [
        {"diagnostic": name, "words": "of mine", "better": better, "values": [0.9, 0.5]}
        for name, better in (("mine", 1), ("error", -1))
    ]
    known = found.replace(
        diagnostics=[
            {**of_all, **codes, **each, "representations": ["full", "dae-8"]} for each in told
        ]
    )
    (plot,) = [plot for plot in study_plots(known) if plot.name == "diagnostics"]
    mine, error = drawn(plot).axes
    assert mine.lines[1].get_xydata().tolist() == [[0.5, 500.0]]
    assert error.get_xlim()[0] > error.get_xlim()[1]
