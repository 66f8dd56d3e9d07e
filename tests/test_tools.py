"""The tools that make what ships and what results/ shows, at small size."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_up import write_record

from jbrep.dataset import Dataset, ScaledDataset
from jbrep.encoders import load
from jbrep.envs import describe
from jbrep.errors import InputError
from jbrep.methods.registry import METHODS
from jbrep.records.tables import write_rows
from jbrep.rl import Run
from jbrep.rl.files import EPISODES, Episode
from jbrep.stats.association import rank_correlation
from jbrep.studies.tables import Return
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


def test_the_best_agent_is_the_best_at_the_end_of_training(tmp_path):
    import policies

    for seed, late in ((0, 300.0), (1, 500.0), (2, 400.0)):
        folder = tmp_path / "study" / str(seed)
        folder.mkdir(parents=True)
        run = Run.of(FACE, "sac", seed=seed, steps=1000, preset="paper")
        write_record(folder, run)
        returns = ((500, 900.0 - late), (1000, late))
        rows = [Episode(s, i, v, 100, False) for s, v in returns for i in range(policies.LAST)]
        write_rows(folder / EPISODES, rows, Episode)
    assert policies.best([tmp_path]) == {FACE: (500.0, tmp_path / "study" / "1")}


def test_the_search_for_a_gait_tells_constants_and_returns(capsys, monkeypatch):
    import tune_heuristics as tool

    short = describe(FACE).replace(max_episode_steps=20)
    monkeypatch.setattr(tool, "describe", lambda name: short)
    for name, value in (("SEARCH_EPISODES", 2), ("TEST_EPISODES", 2), ("REPORT_EVERY", 1)):
        monkeypatch.setattr(tool, name, value)
    monkeypatch.setattr(sys, "argv", ["tune", FACE, "--minutes", "0.001"])
    tool.main()
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("generation 1: ")
    assert "Turn(" in told[0]


@pytest.mark.parametrize(
    ("given", "code", "line"),
    [
        (["--help"], 0, "usage: attack"),
        (["1", "report", "reprot"], 2, "unknown surface 'reprot': choose from tune, checkpoints"),
        (["0"], 2, "usage: attack"),
    ],
)
def test_what_can_be_attacked_is_told(given, code, line, capsys, monkeypatch):
    import attack

    monkeypatch.syspath_prepend(attack.HELPERS)
    monkeypatch.setattr(sys, "argv", ["attack.py", *given])
    with pytest.raises(SystemExit) as ended:
        attack.main()
    assert ended.value.code == code
    assert "".join(capsys.readouterr()).startswith(line)


def test_scores_are_held_against_returns_of_the_same_encoders(tmp_path, capsys, monkeypatch):
    import worth

    finals = {
        "full": 0.0,
        "vae-8": 10.0,
        "pca-8": 20.0,
        "dae-8": 30.0,
        "slow-8": 40.0,
        "ofe-64": 9.0,
    }
    labels = {
        code: SimpleNamespace(
            settings=SimpleNamespace(task=FACE, representation=code),
            encoder=SimpleNamespace(kind=code.partition("-")[0]),
        )
        for code in finals
    }
    codes = [code for code in finals if code != "full"]
    seeds, grid = (0, 1), np.array([0, 30_000, 60_000, 90_000])
    group = SimpleNamespace(
        task=FACE,
        algorithm="sac",
        grid=grid,
        failure_return=-1.0,
        labels=[
            SimpleNamespace(
                representation=code, seeds=seeds, by_run={"final_return": np.full(2, finals[code])}
            )
            for code in finals
        ],
    )
    returns = [  # at first those are ahead that end behind
        Return(FACE, "sac", code, seed, int(step), 0, finals[code] * (1 if step == 90_000 else -1))
        for code in codes
        for seed in seeds
        for step in grid
    ]
    tables = SimpleNamespace(
        name="a study",
        analysis=SimpleNamespace(groups=[group]),
        returns=returns,
        record=SimpleNamespace(
            runs=[SimpleNamespace(label=code, encoder=f"hash of {code}") for code in finals],
            labels=labels,
            missing={},
        ),
    )
    evaluation = SimpleNamespace(
        data=SimpleNamespace(task=FACE),
        encoders={
            code: SimpleNamespace(
                latent=int(code.partition("-")[2]),
                known={"rewarded": -finals[code], "reward": finals[code]},
            )
            for code in codes
        },
        hashes={code: f"hash of {code}" for code in codes},
    )
    rows = [f"{code},hash of {code},trees,{finals[code] ** 2}" for code in codes]
    (tmp_path / "scores").mkdir()
    learned = tmp_path / "scores/learned.csv"
    learned.write_text("\n".join(("code,sha256,way,final", *rows)))
    judged = SimpleNamespace(serving=["slow-8", "dae-8"], take="dae-8")
    monkeypatch.setattr(worth, "judge", lambda known: judged)
    monkeypatch.setattr(worth, "read_tables", lambda folder: tables)
    monkeypatch.setattr(worth, "read_document", lambda path, kind: evaluation)
    monkeypatch.setattr(worth, "headline", lambda each: each.known)
    worth.main(tmp_path)
    lines = [re.split(" {2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]
    assert lines[2] == ["ranked by", FACE, "mean", "above rewarded", "above a short run"]
    told = {name: [cell.split()[0] for cell in cells] for name, *cells in lines[3:9]}
    assert told == {
        "rewarded": ["-1.00", "-1.00", "0.00", "0.00"],
        "reward": ["1.00", "1.00", "2.00", "2.00"],
        "how many numbers": ["-0.71", "-0.71", "0.29", "0.29"],  # the largest returns least
        "trees": ["1.00", "1.00", "2.00", "2.00"],
        "a short run": ["-1.00", "-1.00", "0.00", "0.00"],
        "a whole run": ["1.00", "1.00", "2.00", "2.00"],
    }
    assert lines[10][0].endswith("and clearly above both others: it is so")
    assert lines[14] == ["task", "0 to 0.05", "0.05 to 0.1", "0.1 to 0.2", "0.2 or more"]
    assert lines[15][1:] == ["0 of 0"] * 3 + ["0 of 10"]
    assert lines[19][1:] == ["to take", "should serve", "the others", "best of all"]
    assert lines[20] == [FACE, "dae-8 30", "2: 35", "3: 13", "slow-8 40"]
    assert lines[24] == ["code", *told, "final return"]
    assert lines[25] == ["slow-8", "-40", "40", "8", "1,600", "-40", "40", "40"]
    assert [line[0] for line in lines[25:]] == ["slow-8", "dae-8", "pca-8", "vae-8", "ofe-64"]
    for code, value in zip(codes, (0.5, 0.52, 0.58, 0.8, 0.1), strict=True):
        evaluation.encoders[code].known["rewarded"] = value
    worth.main(tmp_path)
    lines = [re.split(" {2,}", line.strip()) for line in capsys.readouterr().out.splitlines()]
    assert lines[15][1:] == ["1 of 1", "2 of 2", "0 of 0", "7 of 7"]
    returns[:] = [r for r in returns if (r.representation, r.seed, r.step) != ("dae-8", 0, 60_000)]
    worth.main(tmp_path)  # of a run that failed before: it counts as -1, above -10 to -40 and -9
    lines = capsys.readouterr().out.splitlines()
    assert float(lines[7].split()[3]) > -1
    tables.record.missing = {"a run": 7}
    with pytest.raises(InputError, match="a study lacks runs of one task: run the study to its en"):
        worth.main(tmp_path)
    tables.record.missing = {}
    evaluation.hashes["dae-8"] = "of another"
    with pytest.raises(InputError, match="dae-8: agents trained on another code than the one sco"):
        worth.main(tmp_path)
    evaluation.hashes["dae-8"] = "hash of dae-8"
    learned.write_text("code,sha256,way,final\ndae-8,of another,trees,7")
    with pytest.raises(InputError, match="dae-8 is another code than the one judged"):
        worth.main(tmp_path)


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
    *_, position = starts_told(capsys)
    assert [*position.values()][:5] == [
        *(["1 of 57"], ["2 of 33"], ["5 of 33"], ["21 of 27"], ["29 of 150"])
    ]


def test_agents_without_a_jump_hesitate_where_the_target_is_behind(capsys):
    """As the page of results/answer-face-direction says."""
    import hard_starts

    hard_starts.main(ROOT / "results/answer-face-direction")
    (rows,) = starts_told(capsys)
    assert rows["2.8 to 3.142 rad to the target"] == [
        *("55 of 80", "80 of 80", "63 of 80", "4 of 80", "59 of 80")
    ]


def test_where_no_start_is_hard_failures_are_spread_over_all(capsys):
    """As the page of results/answer-move-from-origin says."""
    import hard_starts

    hard_starts.main(ROOT / "results/answer-move-from-origin")
    (rows,) = starts_told(capsys)
    on_coordinates = {name: row[0] for name, row in rows.items()}
    assert on_coordinates["all"] == "110 of 800"
    assert on_coordinates["starts where any does"] == "44 of 50"
    assert on_coordinates["at one start, at most"] == "7"
    assert rows["median return"] == ["968", "815", "951", "945", "969"]


def starts_told(capsys):
    """The rows that tools/hard_starts.py printed, by name, for each task."""
    tables = capsys.readouterr().out.strip().split("\n\n")
    return [
        {name: cells for name, *cells in (re.split(" {2,}", row) for row in rows)}
        for _, _, *rows in map(str.splitlines, tables)
    ]


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
    names, _, *rows = map(cells, table.splitlines())
    assert set(names[1:]) == set(tasks[1:])
    observed = ("full", "coordinates", "symmetry", "forward-8-symmetry", "dae-12")
    blind = ("standing still", "constant drive", "random")
    for task, *column in zip(names[1:], *(row[1:] for row in rows), strict=True):
        best = max(means.get((policy, task), 0) for policy in blind)
        assert [int(each) for each in column] == [*(means[each, task] for each in observed), best]


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
