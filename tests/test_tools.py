"""The tools that make what ships and what results/ shows, at small size."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.encoders import load
from jbrep.envs import describe
from jbrep.methods.registry import METHODS
from jbrep.stats.intervals import rank_correlation
from jbrep.training.method import Learned

ROOT = Path(__file__).parent.parent
FACE, MOVE = "face_direction", "move_in_direction"


@pytest.fixture(autouse=True)
def tools(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")


def test_ablations_give_and_take_a_feature(tmp_path):
    import ablate

    ablate.main(ablate.STUDIES["ablation-speed"], tmp_path)
    codes = {path.stem: load(path) for path in (tmp_path / MOVE).iterdir()}
    assert sorted(codes) == [
        *("dae-8-with-speed", "dae-8-with-speed-and-yaw-rate"),
        *("forward-8-without-speed", "full-without-speed"),
    ]
    rows = Dataset(ROOT / "data/sample" / MOVE)["observation"][:50]
    changed = rows.copy()
    changed[:, describe(MOVE).feature_names.index("velocity_in_target_frame_x")] += 0.1
    differs = {n: np.abs(e.encode(rows) - e.encode(changed)).max(0) for n, e in codes.items()}
    assert differs["dae-8-with-speed"][-1] > 0.01
    assert len(differs["dae-8-with-speed"]) == 9
    assert not differs["forward-8-without-speed"].any()
    assert not differs["full-without-speed"].any()


def test_the_overview_of_encoders_is_the_one_on_their_page(capsys, monkeypatch):
    import encoders

    monkeypatch.setattr(sys, "argv", ["encoders", "data", "encoders", "results/encoders"])
    encoders.main()
    page = (ROOT / "results/encoders/README.md").read_text()
    lines = capsys.readouterr().out.strip().splitlines()
    rows = {line for line in lines[2:] if line.split("|")[1].strip() != "full"}
    assert len(rows) > 20
    assert not [line for line in rows if line not in page]


def test_scores_are_compared_on_the_same_resamples():
    """What ranks codes as another score does is above it by nothing, whatever is drawn."""
    import worth

    x, noise = np.random.default_rng(0).normal(size=(2, 12))
    good, bad, families = [(x, x + noise)] * 2, [(noise, x)] * 2, [*"aabbccddeeff"]
    one = rank_correlation(*good[0], families)
    assert worth.mean_rank_correlation(good, families) == pytest.approx(one)
    assert worth.difference(good, [(2 * x, x + noise)] * 2, families) == (0, 0, 0)
    value, low, high = worth.difference(good, bad, families)
    assert value == pytest.approx(one.value - rank_correlation(*bad[0], families).value)
    assert low < value < high


def test_hard_starts_are_those_where_episodes_fail(capsys):
    """As the page of results/figure-7-sac says: 8 of 123 nearer than 16 cm, 21 of 27 beyond."""
    import hard_starts

    hard_starts.main(ROOT / "results/figure-7-sac")
    *_, position = capsys.readouterr().out.strip().split("\n\n")
    cells = [re.split(" {2,}", row)[1:] for row in position.splitlines()[2:7]]
    assert cells == [["1 of 57"], ["2 of 33"], ["5 of 33"], ["21 of 27"], ["29 of 150"]]


def cells(line):
    """The cells of a row of a table in Markdown."""
    return [cell.strip(" `") for cell in line.strip("|").split("|")]


def test_the_tables_of_the_answer_are_those_on_the_pages(capsys, tmp_path):
    import answer

    folders = sorted(str(each) for each in (ROOT / "results").glob("answer-*"))
    answer.main(str(tmp_path / "a.png"), *folders)
    assert (tmp_path / "a.png").stat().st_size > 10_000
    told = capsys.readouterr().out.splitlines()
    assert set(told) <= {*(ROOT / "results/README.md").read_text().splitlines()}
    tasks, _, *rows = map(cells, told)
    means = {
        (row[0], task): int(cell.partition(" ")[0].strip(","))
        for row in rows
        for task, cell in zip(tasks[1:], row[1:], strict=True)
        if cell
    }
    front = (ROOT / "README.md").read_text()
    table = front[front.index("| agents observe") :].partition("\n\n")[0]
    names, _, *rows = ([name, *row] for name, _, *row in map(cells, table.splitlines()))
    assert set(names[1:]) == set(tasks[1:])
    observed = ("full", "coordinates", "symmetry", "forward-8-symmetry", "dae-12")
    blind = ("standing still", "constant action", "random")
    for task, *column in zip(names[1:], *(row[1:] for row in rows), strict=True):
        best = max(means.get((policy, task), 0) for policy in blind)
        given = [*(means[each, task] for each in observed), best, means["scripted", task]]
        assert [int(each) for each in column] == given


def test_the_benchmark_of_methods_takes_each_of_them(monkeypatch):
    """One that is added may need settings there."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import methods as benchmark

    data = ScaledDataset(Dataset(ROOT / "data/sample" / FACE))
    for method in METHODS.values():
        chosen = benchmark.usual(method)
        chosen.check_data(data)
        if isinstance(chosen, Learned):
            chosen.objective(data)


def test_the_paper_s_table_has_a_row_for_each_task_and_algorithm(capsys, tmp_path):
    import table

    table.main(str(tmp_path / "it.png"), str(ROOT / "results/small-face-direction"))
    assert "sac-wide | 473 ± " in capsys.readouterr().out.splitlines()[2]
