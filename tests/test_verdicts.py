"""A study of known truth, registered, looked at twice, and extended; and what can't be decided."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import jbrep
from made_up import SEEDS, STUDY, make_runs, of_a_commit
from small import adopt

from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.report import report
from jbrep.report.answer import answer
from jbrep.report.markdown import markdown
from jbrep.report.report import statistics, write_report
from jbrep.report.statistics import group_tables
from jbrep.report.tables import read_tables
from jbrep.report.words import deciding, told
from jbrep.stats.bootstrap import Interval
from jbrep.stats.power import Arms, Prospect, prospects
from jbrep.stats.rules import Planned, Rules
from jbrep.study.config import as_study
from jbrep.study.plan import Plan
from jbrep.study.record import RECORD
from jbrep.study.results import write_tables
from jbrep.study.runner import register_study
from jbrep.study.tables import REFERENCE_RETURNS

DOCS = Path(__file__).parent.parent / "docs" / "verdicts.md"


@pytest.fixture(scope="module")
def looks(tmp_path_factory):
    """The reports of a study after 5, 8 and all of its seeds, and after more were added."""
    folder = tmp_path_factory.mktemp("looks") / "runs" / "decide"
    with of_a_commit():
        register_study(Plan(STUDY, folder))
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "study_plots", lambda *_: [])
        for seeds in (5, 8, SEEDS, SEEDS + 2):
            plan = Plan(STUDY.replace(seeds=tuple(range(max(seeds, SEEDS)))), folder)
            plan.write()
            make_runs(plan, range(seeds))
            write_tables(folder)
            page, _, text, *_ = write_report(read_tables(folder), folder)
            analysis = read_tables(folder).analysis
            found[seeds] = analysis, page.read_text(), text.read_text()
            if seeds == SEEDS:
                tables = {path.name: path.read_bytes() for path in folder.glob("*.*")}
    whole = folder.parent / "whole"
    whole.mkdir()
    for name, content in tables.items():
        (whole / name).write_bytes(content)
    return folder, found


def cell(analysis, task, name):
    (group,) = [group for group in analysis.groups if group.task == task]
    (found,) = [each for each in group.comparisons if each.representation == name]
    return found.verdicts


def words(verdicts):
    return [verdict.verdict for verdict in verdicts]


def test_before_a_look_there_are_curves_and_counts_alone(looks):
    analysis, page, text = looks[1][5]
    assert words(cell(analysis, "face_direction", "dae-8")) == ["not yet"] * 4
    assert "Nothing is decided yet: the first look is at 8 runs of each arm." in page
    assert "![Final returns]" in text
    assert [each.representation for each in analysis.open_aggregates] == ["full"]
    told = statistics(analysis)
    assert {each["representation"] for each in told["aggregates"]} == {"full"}
    numbers = [[bool(each["numbers"]) for each in group["comparisons"]] for group in told["groups"]]
    assert numbers == [[False] * 2, [True] * 2]
    assert words(cell(analysis, "move_in_direction", "dae-8")) == ["exploratory"] * 4
    tables = [group_tables(group, analysis) for group in analysis.groups]
    titles = [[table.title.split(".")[0] for table in each] for each in tables]
    assert ["Compared with full" in each for each in titles] == [False, True]
    assert [each[-1] for each in titles] == ["Verdicts", "move_in_direction, sac"]
    _, header, rows = tables[1][-1]
    assert header[:2] == ("representation", "of full's gain")
    assert [row[0] for row in rows] == ["dae-8", "pca-8"]


def test_a_look_decides_what_is_far_from_its_boundary(looks):
    analysis, _, _ = looks[1][8]
    worse, *others = cell(analysis, "face_direction", "pca-8")
    assert (worse.verdict, worse.look, worse.runs) == ("contradicted", 1, (8, 8))
    assert {each.reason for each in others} == {"not tested: 'not worse' is contradicted"}
    better, *_ = cell(analysis, "face_direction", "dae-8")
    assert (better.verdict, better.look) == ("undecided", 1)


def test_the_end_says_what_is_true(looks):
    analysis, page, text = looks[1][SEEDS]
    verdicts = cell(analysis, "face_direction", "dae-8")
    assert words(verdicts) == ["supported"] * 4
    kept, spread, time, _ = verdicts
    assert kept.estimate.low < (848 - 250) / (850 - 250) < kept.estimate.high
    assert 5 / 25 < spread.estimate.value < 0.5  # less than the ends alone, by the time before
    assert time.estimate.low < -1500 < time.estimate.high
    said = "Decided: &#39;not worse&#39; is supported for dae-8"
    assert said in page
    assert "what ran is what was registered." in text
    assert "none from what was registered" in page
    full, better, worse = analysis.aggregates
    assert full.tasks == ("face_direction", "move_in_direction")
    over = [group.reference for group in analysis.groups]
    gains = [(500 - each) / (850 - each) for each in over]
    assert 1 - worse.optimality_gap.value == pytest.approx(np.mean(gains), abs=0.03)
    assert better.optimality_gap.value < 0.02


@pytest.mark.parametrize(
    ("level", "said"),
    [
        (0.05, "95"),
        (0.05 / 3, "98.33"),
        (0.0004, "99.96"),
        (2.5e-6, "99.99975"),
        (0.0, "99.9999999999"),  # a first look so early that its level is no float
    ],
)
def test_no_level_of_an_interval_is_rounded_to_100_percent(looks, level, said):
    verdict, *_ = cell(looks[1][SEEDS][0], "face_direction", "dae-8")
    assert deciding(replace(verdict, level=level)).endswith(f"] at {said} %")


def test_a_verdict_may_come_where_other_starts_might_change_whether_agents_learned(looks):
    tables = read_tables(looks[0].parent / "whole")
    (group, other), analysis = tables.analysis.groups, tables.analysis
    unclear = replace(group, labels=(replace(group.labels[0], learnt="unclear"), *group.labels[1:]))
    said = answer(tables._replace(analysis=replace(analysis, groups=(unclear, other))))[-1]
    assert said.startswith(
        "Agents on full didn't clearly learn on face_direction, sac: nothing but what was "
        "registered can be compared there; for that it is enough to end above the best policy that "
        "doesn't look on these starts. Decided: 'not worse' is supported for dae-8"
    )


def test_what_rounds_to_no_steps_has_no_direction():
    assert told("faster", Interval(-0.4, -1234.5, 0.6)) == "0 [1,234 faster, 1 slower]"


def test_seeds_that_were_added_are_exploratory(looks):
    analysis, page, text = looks[1][SEEDS + 2]
    first, *_ = cell(analysis, "face_direction", "dae-8")
    assert (first.verdict, first.runs) == ("supported", (SEEDS, SEEDS))
    assert "seeds were added, whose runs are exploratory: 16, 17" in page
    assert "gains are over constant drive; shares are of the runs that verdicts count" in text
    assert f"Difference of final returns, of all {2 * SEEDS + 4} runs" in page


def test_there_is_no_verdict_over_policies_that_are_not_known(looks, tmp_path):
    shutil.copytree(looks[0].parent / "whole", tmp_path / "less")
    path = tmp_path / "less" / REFERENCE_RETURNS
    path.write_text(re.sub(r".*constant drive.*\n", "", path.read_text()))
    adopt(tmp_path / "less" / RECORD, REFERENCE_RETURNS)
    tables = read_tables(tmp_path / "less")
    found = cell(tables.analysis, "face_direction", "dae-8")
    why = (
        "what constant drive would return isn't known, and gains count over it: make the report "
        "where face_direction is installed"
    )
    assert {(each.verdict, each.reason) for each in found} == {("not yet", why)}
    assert f"**Nothing is decided yet: {why}.**" in markdown(tables, [], [], "figure.png")
    (group, other), comparisons = tables.analysis.groups, tables.analysis.groups[0].comparisons
    later = replace(comparisons[1], verdicts=[replace(v, reason="no run") for v in found])
    group = replace(group, comparisons=(comparisons[0], later))
    analysis = replace(tables.analysis, groups=(group, other))
    assert f"Nothing is decided yet: {why}; no run." in answer(tables._replace(analysis=analysis))


def test_a_reader_gets_the_numbers_with_numpy_alone(looks, monkeypatch, capsys):
    """By the lines in the docs."""
    folder, found = looks
    (block,) = re.findall(r"^```python\n(import numpy.*?)^```", DOCS.read_text(), re.M | re.S)
    assert len([line for line in block.splitlines() if line]) <= 15
    monkeypatch.chdir(folder.parent / "whole")
    exec(compile(block.replace("runs/demo/", ""), "block", "exec"), {})
    printed = dict(line.split(": ", 1) for line in capsys.readouterr().out.splitlines())
    analysis = found[SEEDS][0]
    group = analysis.groups[0]
    for label in group.labels:
        mean, deviation = (label.numbers[f"final_return_{each}"].value for each in ("mean", "sd"))
        expected = [f"final return {mean:.1f}", f"SD {deviation:.1f}"]
        if label.representation == "dae-8":  # pca-8 was decided at the first look
            kept = cell(analysis, "face_direction", "dae-8")[0].estimate.value
            expected.append(f"{kept:.3f} of the gain")
        assert printed[label.representation].split(", ")[: len(expected)] == expected


# before a study


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"verdicts": {"primary": ["face_direction/sac/pca-4"]}},
            "verdicts.primary has face_direction/sac/pca-4: it must be of TASK/ALGORITHM/REPRESENT",
        ),
        ({"verdicts": {"primary": ["face_direction/sac/full"]}}, "verdicts.primary has face_direc"),
        (
            {"seeds": 7},
            "no outcome could support 'not worse' of face_direction/sac/dae-8: a side has 7 runs",
        ),
        ({"tasks": ["Jitterbug/FaceDirection-v0"]}, "say face_direction, as tables do, where"),
        ({"seeds": 12}, "even if all 12 runs learn, up to 26 % may fail, and the limit is 25 %"),
        ({"verdicts": {"margins": 0.1}}, "unknown verdicts.margins"),
        ({"verdicts": {"margin": "a tenth"}}, "verdicts.margin is 'a tenth': it must be"),
        ({"verdicts": {"looks": [0.99, 1]}}, "of 16 seeds, they come after 16 and 16"),
        ({"verdicts": {"primary": ["a", "a"]}}, "each cell may be there once"),
    ],
)
def test_rules_that_do_not_fit_the_study(changes, message):
    with pytest.raises(InputError, match=message) as raised:
        as_study({**to_plain(STUDY), **changes})
    assert "\n" not in str(raised.value)


def test_a_dry_run_tells_what_could_be_found(tmp_path, monkeypatch):
    monkeypatch.setattr("jbrep.study.packing.estimate", lambda runs: 60)
    (tmp_path / "it.toml").write_text(STUDY.toml())
    told = jbrep("study", tmp_path / "it.toml", "--dry-run", "--out", tmp_path / "out")
    assert told.exit_code == 0, told.output
    words = " ".join(told.output.split())
    assert "face_direction/sac/dae-8: less variance" in words
    assert "Verdicts may come after 8 and 16 runs of each arm" in words
    assert "exploratory: its report" not in words
    assert "Where between 10 and 25 % of runs fail, 'not worse' is wrongly supported" in words


def test_power_is_that_of_the_t_test():
    """Against statsmodels, where shares of the gain hardly differ from 1."""
    power = pytest.importorskip("statsmodels.stats.power")
    rules = Rules(primary=("a/b/c",), looks=(1.0,), margin=0.1)
    planned, arms = Planned(rules, tuple(range(16))), {"a/b/c": Arms(16, 16, 16)}
    found = {each.claim: each for each in prospects(planned, arms)}
    first = found["not worse"]
    assert isinstance(first, Prospect)
    expected = power.TTestIndPower().power(0.1 / 0.1, 16, 0.05)
    assert first.power[1] == pytest.approx(expected, abs=0.08)
    assert first.power == tuple(sorted(first.power, reverse=True))
    assert found["faster"].power == pytest.approx(first.power, abs=0.05)  # a tenth, too
    steady = found["less variance"]
    assert steady.least_p == pytest.approx(2e-4)
    assert np.diff(steady.power).min() >= 0
    assert steady.power[-1] > 0.9
