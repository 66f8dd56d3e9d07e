"""A report is whole by itself, says what the tables say, and refuses what isn't one."""

import csv
import html
import json
import re
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from made_up import STUDY as CLAIMED
from made_up import make_runs, of_a_commit, write_record
from small import adopt, forge
from wide import wide

from jbrep.encoders import find, save
from jbrep.errors import DamageError, InputError, Notice
from jbrep.evaluation.diagnosis import SCALARS, diagnose
from jbrep.evaluation.evaluation import _REGISTERED, Scalar, Score, diagnostic
from jbrep.evaluation.table import (
    DIAGNOSTICS,
    Diagnosed,
    by_label,
    diagnostics_text,
    headline,
    read_diagnostics,
)
from jbrep.play.sources import find_episode
from jbrep.records.document import document_from, read_document
from jbrep.records.tables import write_csv, write_rows
from jbrep.reporting import report
from jbrep.reporting.evaluation import evaluation_text
from jbrep.reporting.figures import study_plots, write
from jbrep.reporting.findings import Findings
from jbrep.reporting.report import (
    FINDINGS,
    MARKDOWN,
    PAGE,
    commands,
    make_report,
    results_text,
    summary,
    write_report,
)
from jbrep.reporting.tables import read_tables
from jbrep.reporting.views import say, settings_tables, verdict_tables
from jbrep.rl.files import ENCODER, EVALUATIONS, Evaluation, read_run
from jbrep.stats.rules import Rules
from jbrep.studies.config import Study, as_study
from jbrep.studies.plan import Plan
from jbrep.studies.record import RECORD, RunsRecord
from jbrep.studies.runner import register_study
from jbrep.studies.tables import REFERENCE_RETURNS, play_references, run_of, write_tables

FINAL = {"full": 800, "dae-8": 300, "pca-8": 820}
STUDY = Study(
    tasks=("face_direction",),
    algorithms=("sac",),
    representations=tuple(FINAL),
    seeds=(0, 1, 2, 3),
    steps=2000,
    evaluate_every=1000,
    evaluation_episodes=2,
    final_episodes=2,
)
POLICIES = ("standing still", "constant action", "random", "scripted")
TABLES = ("runs.json", "returns.csv", "references.csv")
TRAP = "<script>document.title = 'run'</script>"


DRAWN = as_study(
    {
        **{"tasks": ["face_direction"], "representations": ["full", "dae-8"], "seeds": 4},
        **{"steps": 2000, "evaluate_every": 1000},
        **{"evaluation_episodes": 2, "final_episodes": 2},
        "algorithms": {"drawn": {"base": "sac", "draws": {"tau": [0.01, 0.02], "gamma": [0.9, 1]}}},
    }
)


def write_a_run(plan, cell, failed=False, reason=TRAP):
    """A run's files as jbrep rl leaves them, with returns made up."""
    folder = plan.folder_of(cell)
    folder.mkdir(parents=True)
    run = plan.run(cell)
    encoder = find(run.encoder, run.task)
    save(encoder, folder / ENCODER)
    random = np.random.default_rng([cell.seed, len(cell.representation.name)])
    final = FINAL[cell.representation.name] + random.normal(0, 30)
    rows = [
        Evaluation(step, episode, float(np.clip(mean + random.normal(0, 5), 0, 1000)))
        for step, mean in ((0, 100), (1000, final / 2), (2000, final))
        for episode in range(2)
    ]
    rows = rows[: 4 if failed else 6]
    tables = {EVALUATIONS: write_rows(folder / EVALUATIONS, rows, Evaluation)}
    facts = {"versions": {"jbrep": "0.1.0", "torch": "2.13.0+cpu"}, "tables": tables}
    write_record(folder, run, reason if failed else None, steps=1500 if failed else 2000, **facts)


def make_study(folder, left=0, failed=(), study=STUDY):
    plan = Plan(study, folder)
    plan.write()
    for i, cell in enumerate(plan.cells[: len(plan.cells) - left]):
        write_a_run(plan, cell, failed=i in failed)
    return plan


@pytest.fixture(scope="module", autouse=True)
def one_picture():
    """The page has all figures in it; as files, one is enough here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "write", lambda plots, folder: write(plots[:1], folder))
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory, one_picture):
    """The folder of a study at its end, with one failed run, and its report."""
    folder = tmp_path_factory.mktemp("whole") / "a-study"
    make_study(folder, failed=(1,))
    write_tables(folder)
    write_policies(folder, STUDY)
    write_report(found_in(folder), folder)
    return folder


def found_in(folder):
    return Findings.of(read_tables(folder))


def write_policies(folder, study):
    """What policies return that don't learn, made up."""
    rows = [
        ("face_direction", policy, episode, mean + 20 * episode)
        for policy, mean in zip(POLICIES, (250, 237, 100, 940), strict=True)
        for episode in range(study.final_episodes)
    ]
    columns = ("task", "policy", "episode", "return")
    sha256 = write_csv(folder / REFERENCE_RETURNS, columns, rows)
    record = read_document(folder / RECORD, RunsRecord)
    record.with_table(REFERENCE_RETURNS, sha256).write(folder / RECORD)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """The tables of a study with claims on eight seeds."""
    folder = tmp_path_factory.mktemp("judged") / "decide"
    claims = CLAIMED.verdicts.replace(margin=0.5)  # as of eight runs a third may fail, unseen
    study = CLAIMED.replace(tasks=("face_direction",), seeds=tuple(range(8)), verdicts=claims)
    with of_a_commit():
        register_study(Plan(study, folder))
    make_runs(Plan(study, folder), study.seeds)
    write_tables(folder)
    write_policies(folder, study)
    return folder


def test_the_table_that_answers_comes_first(whole):
    page = (whole / PAGE).read_text()
    assert "all numbers are exploratory" in page
    assert TRAP not in page  # but as text
    told = results_text(found_in(whole), 80)
    learned = {line.split()[0]: line.split() for line in told.splitlines() if "[" in line}
    assert "yes" in learned["full"]
    assert "no" in learned["dae-8"]
    assert max(map(len, told.splitlines())) <= 80
    assert len(told.splitlines()) < 24
    assert results_text(found_in(whole), 80, everything=True).startswith(told)


def test_verdicts_are_the_same_wherever_they_are_told(judged, tmp_path):
    """On the page, in the summary and in the findings, which are what the statistics say."""
    tables = read_tables(judged)
    verdicts, given = tables.analysis.verdicts, Findings.of(tables)
    path, page, text, _ = write_report(given, tmp_path)
    found = document_from(json.loads(path.read_text()), path, Findings)
    assert found == given
    assert [each.verdict for each in found.verdicts] == [each.verdict for each in verdicts]
    assert {each.verdict for each in found.verdicts} == {"supported", "undecided"}
    (table,) = verdict_tables(found)
    assert [row[0] for row in table.rows] == [*tables.raw.record.study.verdicts.claims]
    section = html.unescape(page.read_text()).partition('<section id="verdicts">')[2]
    section = section.partition("</section>")[0]
    for row in table.rows:
        assert f"| {' | '.join(row)} |".replace("<", r"\<") in text.read_text()
        assert all(f">{cell}</td>" in section for cell in row)
    assert str(found.comparisons) in say("rules", found.comparisons, found.error, 8)


def test_the_markdown_shows_numbers_and_a_figure_that_is_there(whole):
    text = (whole / MARKDOWN).read_text()
    assert text.startswith("# face_direction: full, dae-8, pca-8\n")
    order = ("> Failed runs: 1.", "| agents on |", "![", "compared with full:")
    assert [text.index(each) for each in order] == sorted(text.index(each) for each in order)
    (figure,) = re.findall(r"!\[.*\]\((.*)\)", text)
    assert (whole / figure).exists()
    assert "a failed run counts as return 0 from then on, the least possible." in text
    assert re.search(r"\n\| standing still \| .* \| 260 \[", text)
    found = json.loads((whole / FINDINGS).read_text())
    failed = [run for run in found["runs"] if run["status"] == "failed"]
    assert [(run["label"], run["seed"]) for run in failed] == [("face_direction/sac-wide/dae-8", 0)]
    mean = found["groups"][0]["agents"][0]["numbers"]["final_return_mean"][0]
    assert f"| full | - | {mean:.0f} [" in text


def copy_tables(folder, out):
    out.mkdir(exist_ok=True)
    for each in TABLES:
        shutil.copy(folder / each, out / each)


def named_otherwise(folder, out, name):
    """A copy of a study's tables in which dae-8 has another name."""
    out.mkdir()
    for each in TABLES:
        text = (folder / each).read_text()
        quoted = json.dumps(name)[1:-1] if each.endswith("json") else name
        (out / each).write_text(text.replace("dae-8", quoted))
    record = json.loads((out / RECORD).read_text())
    forge(out / RECORD, {**record, "study": None})  # no study has any name
    adopt(out / RECORD, *TABLES[1:])


def test_diagnostics_are_read_by_name_and_set_against_returns(whole, tmp_path):
    """Those of today, whatever else older tables have, and whatever they lack."""
    named_otherwise(whole, tmp_path / "study", "dae-8")
    rows = [("face_direction", name, "0", 0.1 * i, i) for i, name in enumerate(FINAL)]
    write_csv(
        tmp_path / "study" / DIAGNOSTICS,
        ("task", "representation", "sha256", "forward", "of_another_release"),
        rows,
    )
    adopt(tmp_path / "study" / RECORD, DIAGNOSTICS)
    found = found_in(tmp_path / "study")
    assert [each.diagnostic for each in found.diagnostics] == ["forward"]
    assert found.diagnostics[0].values == [0, 0.1, 0.2]
    (plot,) = [plot for plot in study_plots(found) if plot.name == "diagnostics"]
    assert {row["diagnostic"] for row in plot.rows} == {"forward"}
    row = ("forward", SCALARS["forward"].words, "-", "3")  # three codes are too few to correlate
    assert f"| {' | '.join(row)} |" in summary(found)


def test_it_can_be_made_from_the_tables_alone(whole, tmp_path):
    alone = tmp_path / "a-study"
    copy_tables(whole, alone)
    found = found_in(alone)
    assert found.text() == (whole / FINDINGS).read_text()
    assert summary(found) == (whole / MARKDOWN).read_text()


def test_no_line_to_copy_runs_what_a_stranger_wrote(whole, tmp_path):
    trap = "$(touch trap); touch trap #"
    for code in commands(found_in(whole).replace(name=trap, imports=[trap])).values():
        if code.startswith(("jbrep ", "pip ")):
            script = f"jbrep() {{ :; }}; pip() {{ :; }}; {code}"
            subprocess.run(["sh", "-c", script], cwd=tmp_path, check=True)
    assert not list(tmp_path.iterdir())


def test_settings_that_seeds_draw_are_alike_for_all_that_agents_observe(tmp_path):
    plan = make_study(tmp_path, study=DRAWN)
    drawn = {}
    for cell in plan.cells:
        settings = read_run(plan.folder_of(cell)).settings
        values = settings.overrides["tau"], settings.overrides["gamma"]
        assert settings.hyperparameters.algorithm_kwargs["tau"] == values[0]
        drawn.setdefault(cell.seed, set()).add(values)
    assert {len(each) for each in drawn.values()} == {1}
    assert len(set.union(*drawn.values())) > 1
    write_tables(tmp_path)
    tables = read_tables(tmp_path)
    assert len(tables.analysis.groups[0].comparisons) == 1
    *_, table = settings_tables(Findings.of(tables))
    assert dict(row[:2] for row in table.rows)["tau"] == "one of 0.01, 0.02, by seed"


def test_a_report_compares_with_the_study_s_baseline(whole, tmp_path):
    copy_tables(whole, tmp_path)
    record = read_document(tmp_path / RECORD, RunsRecord)
    against = record.study.replace(verdicts=Rules(baseline="pca-8"))
    record.replace(study=against).write(tmp_path / RECORD)
    told = summary(found_in(tmp_path))
    assert "share of gain on pca-8" in told
    assert "compared with pca-8" in told
    assert "gain on full" not in told


def test_without_full_a_study_compares_with_its_first_representation():
    claims = Rules(claims=("dae-8 not worse than pca-8",))
    eight = {"representations": ("pca-8", "dae-8"), "seeds": tuple(range(8))}
    study = STUDY.replace(**eight, verdicts=claims)
    assert study.planned.rules.baseline == "pca-8"
    assert study.planned.rules.chains.keys() == {("dae-8", "pca-8")}


@pytest.mark.usefixtures("one_figure")
def test_an_unfinished_study_says_what_is_missing(tmp_path):
    plan = make_study(tmp_path / "half", left=5)
    (plan.folder_of(plan.cells[-1])).mkdir(parents=True)
    (plan.folder_of(plan.cells[-1]) / "progress").write_text("700")
    write_tables(plan.folder)
    path, page, *_ = write_report(found_in(plan.folder), plan.folder)
    found = json.loads(path.read_text())
    assert [*found["missing"]] == [cell.name for cell in plan.cells[-5:]]
    assert len(found["runs"]) == 7
    text = page.read_text()
    assert "Unfinished: 5 of 12 runs missing" in text
    assert "700</td>" in text


def test_a_report_plays_nothing(tmp_path, monkeypatch):
    """Of runs beside which nothing was played, it says what to do."""
    monkeypatch.setattr("jbrep.studies.tables.play", None)
    plan = make_study(tmp_path / "unplayed")
    monkeypatch.setattr(report, "study_plots", lambda found: [])
    made = make_report(plan.folder)
    assert made.findings.not_played == ["face_direction"]
    assert "jbrep study plays them" in (plan.folder / MARKDOWN).read_text()
    assert {each.learnt for each in made.findings.groups[0].agents} == {"unclear"}


def test_references_are_played_once_on_the_starts_of_evaluation(tmp_path, monkeypatch):
    study = STUDY.replace(episode_steps=50)
    plan = make_study(tmp_path, study=study)
    write_tables(plan.folder)
    play_references(plan.folder)
    path = plan.folder / REFERENCE_RETURNS
    before = path.read_bytes()
    rows = list(csv.reader(before.decode().splitlines()))
    assert rows[0] == ["task", "policy", "episode", "return"]
    policies = {"standing still": "still", "constant action": "constant:drive=0.75"}
    policies |= {"random": "uniform", "scripted": "heuristic"}
    episodes = study.final_episodes
    assert [row[1] for row in rows[1:]] == [name for name in policies for _ in range(episodes)]
    task = plan.study.task("face_direction")
    for _, name, episode, played in rows[1:]:
        alone = find_episode(policies[name], int(episode), task).reward.sum()
        assert float(played) == pytest.approx(alone, abs=1e-3)
    monkeypatch.setattr("jbrep.studies.tables.play", None)
    write_tables(plan.folder)
    play_references(plan.folder)
    assert path.read_bytes() == before
    path.write_bytes(before.replace(b",1,", b",1,1"))
    with pytest.raises(InputError, match=r"references\.csv was changed"):
        read_tables(plan.folder)
    with pytest.warns(Notice), pytest.raises(InputError, match=r"references\.csv was changed"):
        play_references(plan.folder)
    monkeypatch.undo()
    play_references(plan.folder)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("runs.json", lambda text: text[:100], "runs.json is damaged"),
        ("runs.json", lambda text: text.replace('"2.13.0', '"2; touch P #'), "versions"),
        ("returns.csv", lambda text: text.replace("full,3,1000", "full,3,0"), "episodes"),
        ("returns.csv", lambda text: text + "a,b,c,0,0,0,nan\n", "returns.csv is damaged"),
        ("references.csv", lambda text: text + "x", "references.csv is damaged"),
        ("runs.json", None, "runs.json"),
    ],
)
def test_damaged_tables_are_refused(name, change, message, whole, tmp_path):
    copy_tables(whole, tmp_path)
    path = tmp_path / name
    if change is None:
        path.unlink()
    else:
        path.write_text(change(path.read_text()))
        with suppress(ValueError, TypeError):
            adopt(tmp_path / "runs.json", *TABLES[1:])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match=message):
        read_tables(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


def test_committed_results_have_their_tables():
    for path in Path("results").glob("*/runs.json"):
        there = {each.name for each in path.parent.iterdir()}
        assert json.loads(path.read_text())["tables"].keys() <= there, path


@pytest.mark.parametrize("study", ["ablation-speed", "breadth", "cheetah", "confirm", "longer"])
def test_committed_results_are_those_of_their_tables(study):
    """Findings and summaries come from the tables anew, the same to the byte but for rounding."""
    folder = Path("results") / study
    found = found_in(folder)
    assert summary(found) == (folder / MARKDOWN).read_text()
    check_close(json.loads(found.text()), json.loads((folder / FINDINGS).read_text()))


def check_close(ours, theirs):
    """The same JSON, but for the last digits, which depend on the processor."""
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        ours, theirs = list(ours.values()), [theirs[name] for name in ours]
    if isinstance(ours, list):
        for mine, other in zip(ours, theirs, strict=True):
            check_close(mine, other)
    elif isinstance(ours, float):
        assert ours == pytest.approx(theirs, rel=1e-9)
    else:
        assert ours == theirs


def test_a_run_without_a_curve_is_left_out(whole, tmp_path):
    """Such as a policy that was cloned."""
    copy_tables(whole, tmp_path)
    raw = read_tables(tmp_path).raw
    first = raw.record.runs[0]
    others = [row for row in raw.returns if run_of(row) != (first.label, first.seed)]
    found, refused = raw._replace(returns=others).curves()
    assert len(found) == len(raw.record.runs) - 1
    assert first.label in refused[0]


def test_references_of_an_environment_that_is_not_here_stay(tmp_path, monkeypatch):
    """Even of fewer episodes than are wanted."""

    def away(policy, task, episodes):
        raise InputError("it isn't here")

    plan = make_study(tmp_path / "it")
    write_tables(plan.folder)
    write_policies(plan.folder, STUDY.replace(evaluation_episodes=1, final_episodes=1))
    before = read_tables(plan.folder).raw.references
    monkeypatch.setattr("jbrep.studies.tables.play", away)
    with pytest.warns(Notice, match="couldn't be played on face_direction: it isn't here"):
        play_references(plan.folder)
    assert read_tables(plan.folder).raw.references == before


def test_what_a_report_writes_while_references_are_played_stays(tmp_path, monkeypatch):
    plan = make_study(tmp_path / "it")
    write_tables(plan.folder)

    def meanwhile(policy, task, episodes):
        record = read_document(plan.folder / RECORD, RunsRecord)
        record.with_table("more.csv", "0" * 64).write(plan.folder / RECORD)
        return [1.0] * episodes

    monkeypatch.setattr("jbrep.studies.tables.play", meanwhile)
    play_references(plan.folder)
    tables = read_document(plan.folder / RECORD, RunsRecord).tables
    assert tables.keys() >= {REFERENCE_RETURNS, "more.csv"}


ROWS = [
    Diagnosed("face_direction", "dae-8", "a" * 64, {"forward": 0.25, "value": None}),
    Diagnosed("face_direction", "dae-8", "b" * 64, {"forward": 0.75, "value": -1e-9}),
    Diagnosed("dm_control/cheetah-run-v0", "mine, or not", "c" * 64, {"forward": None}),
]
KEY = "task,representation,sha256"


def test_a_registered_function_is_measured_shown_and_tabled(monkeypatch, tmp_path):
    """Nothing else is to be changed for a further diagnostic."""
    monkeypatch.setattr("jbrep.evaluation.evaluation._REGISTERED", [*_REGISTERED])

    @diagnostic(Scalar("farthest", "the largest mean of a unit", better=-1))
    def farthest(e):
        return Score(max(map(abs, e.known.latent_units.mean)))

    try:
        evaluation = diagnose({"half": lambda rows: rows[:, :2]}, wide([300, 250], features=4))
        assert "farthest" in evaluation.text()
        shown = evaluation_text(evaluation, everything=True)
        assert shown.count("farthest") == 2  # its values, and its words
        known = headline(evaluation.encoders["half"])
        path = tmp_path / "t.csv"
        path.write_text(diagnostics_text([ROWS[0], ROWS[0]._replace(values=known)]))
        one, two = read_diagnostics(path)
        assert two.values["farthest"] == pytest.approx(known["farthest"], rel=1e-5)
        assert one.values["farthest"] is None
    finally:
        del SCALARS["farthest"]


def test_the_docs_have_every_diagnostic():
    page = Path("docs/diagnostics.md").read_text()
    for each in SCALARS.values():
        better = "higher" if each.better > 0 else "lower"
        assert f"| `{each.name}` | {each.words} | {better} |" in page


def test_the_table_comes_back_as_it_was(tmp_path):
    (tmp_path / "t.csv").write_text(diagnostics_text(ROWS))
    names = dict.fromkeys(("forward", "value"))
    assert read_diagnostics(tmp_path / "t.csv") == [
        row._replace(values=names | row.values) for row in ROWS
    ]


def test_encoders_of_one_representation_are_averaged():
    assert by_label(ROWS) == {
        ("face_direction", "dae-8"): {"forward": 0.5, "value": -1e-9},
        ("dm_control/cheetah-run-v0", "mine, or not"): {"forward": None},
    }


@pytest.mark.parametrize(
    "text", ["", "task,sha256,forward\nt,s,1\n", f"{KEY},forward\nt,r,s\n", f"{KEY},x\nt,r,s,nan\n"]
)
def test_another_file_is_refused(text, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DamageError, match=r"t\.csv"):
        read_diagnostics(tmp_path / "t.csv")
    with pytest.raises(InputError, match="none"):
        read_diagnostics(tmp_path / "none.csv")
