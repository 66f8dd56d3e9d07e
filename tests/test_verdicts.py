"""A study of known truth: registered, half done, done, and extended; and what can't be decided."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import jbrep
from made_up import SEEDS, STILL, STUDY, make_runs, of_a_commit
from small import adopt

from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.reporting import report
from jbrep.reporting.findings import Findings
from jbrep.reporting.report import write_report
from jbrep.reporting.tables import read_tables
from jbrep.studies.config import as_study
from jbrep.studies.plan import Plan
from jbrep.studies.record import RECORD
from jbrep.studies.runner import register_study
from jbrep.studies.tables import REFERENCE_RETURNS, play_references, write_tables

DOCS = Path(__file__).parent.parent / "docs" / "verdicts.md"


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    """The reports of a study after half and all of its seeds, and after more were added."""
    folder = tmp_path_factory.mktemp("reports") / "runs" / "decide"
    with of_a_commit():
        register_study(Plan(STUDY, folder))
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "study_plots", lambda found: [])
        returns = {"scripted": 950.0}
        patch.setattr("jbrep.studies.tables.play", lambda p, _, n: [returns.get(p, STILL)] * n)
        for seeds in (8, SEEDS, SEEDS + 2):
            plan = Plan(STUDY.replace(seeds=tuple(range(max(seeds, SEEDS)))), folder)
            plan.write()
            make_runs(plan, range(seeds))
            write_tables(folder)
            play_references(folder)
            tables = read_tables(folder)
            _, page, text, *_ = write_report(Findings.of(tables), folder)
            found[seeds] = tables.analysis, page.read_text(), text.read_text()
            if seeds == SEEDS:
                files = {path.name: path.read_bytes() for path in folder.glob("*.*")}
    whole = folder.parent / "whole"
    whole.mkdir()
    for name, content in files.items():
        (whole / name).write_bytes(content)
    return folder, found


def on_face(analysis):
    own = (v for v in analysis.verdicts if v.task == "face_direction")
    return {f"{v.x} {v.claim} than {v.y}": v for v in own}


def test_before_all_runs_have_ended_nothing_is_decided(reports):
    analysis, page, text = reports[1][8]
    assert {each.verdict for each in analysis.verdicts} == {"undecided"}
    assert {each.reason for each in analysis.verdicts} == {
        f"8 of {SEEDS} runs on {name} have ended" for name in ("dae-8", "pca-8")
    }
    assert "8 of 16 runs on pca-8 have ended" in page
    assert "8 of 16 runs on pca-8 have ended" in text


def test_the_end_says_what_is_true(reports):
    analysis, page, text = reports[1][SEEDS]
    kept, steady, earlier, worse = on_face(analysis).values()
    assert [each.verdict for each in (kept, steady, earlier)] == ["supported"] * 3
    assert worse.verdict == "contradicted"
    assert kept.estimate.low < 848 - 850 < kept.estimate.high
    assert 5 / 25 < steady.estimate.value < 0.5  # less than the ends alone, by the time before
    assert earlier.estimate.low < -1500 < earlier.estimate.high
    assert "what ran is what was registered." in text
    assert '<td class="text supported">supported</td>' in page
    ends = [group.ends for group in analysis.groups]
    best, *_, last = analysis.aggregates
    assert best.tasks == ("face_direction", "move_in_direction")
    scores = [(500 - each.blind) / (each.top - each.blind) for each in ends]
    assert 1 - last.optimality_gap.value == pytest.approx(np.mean(scores), abs=0.03)


def test_seeds_that_were_added_are_exploratory(reports):
    analysis, page, _ = reports[1][SEEDS + 2]
    verdicts = {each.runs for each in analysis.verdicts}
    assert verdicts == {SEEDS}
    assert "seeds were added, whose runs are exploratory: 16, 17" in page
    assert {each.shared for group in analysis.groups for each in group.comparisons} == {SEEDS + 2}


def test_there_is_no_verdict_over_policies_that_are_not_known(reports, tmp_path):
    shutil.copytree(reports[0].parent / "whole", tmp_path / "less")
    path = tmp_path / "less" / REFERENCE_RETURNS
    path.write_text(re.sub(r".*constant action.*\n", "", path.read_text()))
    adopt(tmp_path / "less" / RECORD, REFERENCE_RETURNS)
    found = on_face(read_tables(tmp_path / "less").analysis).values()
    assert {each.verdict for each in found} == {"undecided"}
    assert all("constant action" in each.reason for each in found)


def test_a_reader_gets_the_numbers_with_numpy_alone(reports, monkeypatch, capsys):
    """By the lines in the docs."""
    folder, found = reports
    (block,) = re.findall(r"^```python\n(import numpy.*?)^```", DOCS.read_text(), re.M | re.S)
    assert len([line for line in block.splitlines() if line]) <= 15
    monkeypatch.chdir(folder.parent / "whole")
    exec(compile(block.replace("runs/demo/", ""), "block", "exec"), {})
    printed = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    group = found[SEEDS][0].groups[0]
    kept = {each.representation: each.numbers["share_of_gain"].value for each in group.comparisons}
    for label in group.labels:
        mean, deviation = (label.numbers[f"final_return_{each}"].value for each in ("mean", "sd"))
        expected = [f"final return {mean:.1f}", f"SD {deviation:.1f}"]
        if label.representation in kept:
            expected.append(f"{kept[label.representation]:.3f} of the gain")
        assert printed[label.representation].split(", ")[: len(expected)] == expected


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"verdicts": {"claims": ["pca-4 better than full"]}}, "verdicts.claims"),
        ({"verdicts": {"claims": ["dae-8 worse than full"]}}, "verdicts.claims|claims has"),
        ({"seeds": 7}, "7 runs"),
        ({"tasks": ["Jitterbug/FaceDirection-v0"]}, "face_direction"),
        ({"tasks": ["Pendulum-v1"]}, "verdicts.reference"),
        ({"verdicts": {"margins": 0.1}}, "verdicts.margins"),
        ({"verdicts": {"margin": "a tenth"}}, "verdicts.margin"),
        ({"verdicts": {"baseline": "pca-4"}}, "verdicts.baseline"),
    ],
)
def test_rules_that_do_not_fit_the_study(changes, field):
    with pytest.raises(InputError, match=field) as raised:
        as_study({**to_plain(STUDY), **changes})
    assert "\n" not in str(raised.value)


def test_a_dry_run_tells_what_could_be_found(tmp_path, monkeypatch):
    monkeypatch.setattr("jbrep.studies.forecast.estimate", lambda run: 60)
    (tmp_path / "it.toml").write_text(STUDY.toml())
    told = jbrep("study", tmp_path / "it.toml", "--dry-run", "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    words = " ".join(told.output.split())
    assert "dae-8 less variable than full" in words
    assert "Comparisons: 4, with an error of 5 % among them" in words
    assert "exploratory: its report" not in words
