"""A report is whole by itself, says what the tables say, and refuses what isn't one."""

import csv
import html
import json
import random
import re
import shutil
import subprocess
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import mistake
from jbrep.report.answer import answer
from jbrep.report.facts import full_scaling, reproduce, setting_table
from jbrep.report.markdown import escape, markdown
from jbrep.report.page import page as page_of
from jbrep.report.returns import returns_tables
from jbrep.report.statistics import verdict_tables
from made_up import STUDY as CLAIMED
from made_up import make_runs, of_a_commit, write_record
from small import adopt, assert_same_files, forge

from jbrep.encoders import find, save
from jbrep.envs import describe
from jbrep.envs.view import with_view
from jbrep.errors import InputError
from jbrep.evaluate.table import DIAGNOSTICS, SCALARS, Diagnosed, diagnostics_text
from jbrep.play.sources import find_episode
from jbrep.records.document import read_document
from jbrep.records.tables import write_csv, write_rows
from jbrep.report import make_report, report, write_report
from jbrep.report.figures import study_plots, write
from jbrep.report.report import FIGURES, MARKDOWN, PAGE, STATISTICS, SUMMARY
from jbrep.report.tables import read_tables
from jbrep.rl.files import ENCODER, EVALUATIONS, Evaluation, read_run
from jbrep.stats.rules import Rules
from jbrep.study.config import Study, as_study
from jbrep.study.plan import Plan
from jbrep.study.record import RECORD, RunsRecord
from jbrep.study.results import write_tables
from jbrep.study.runner import register_study
from jbrep.study.tables import REFERENCE_RETURNS, RunInfo, write_references
from jbrep.text import Table

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
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
POLICIES = ("standing still", "constant drive", "random", "hand-written")
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
    write_policies(folder, STUDY)
    write_tables(folder)
    write_report(read_tables(folder), folder)
    return folder


def write_policies(folder, study):
    """What policies return that don't learn, made up."""
    rows = [
        ("face_direction", policy, episode, mean + 20 * episode)
        for policy, mean in zip(POLICIES, (250, 237, 100, 940), strict=True)
        for episode in range(study.final_episodes)
    ]
    write_csv(folder / REFERENCE_RETURNS, ("task", "policy", "episode", "return"), rows)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """The tables of a study with claims on eight seeds."""
    folder = tmp_path_factory.mktemp("judged") / "decide"
    claims = CLAIMED.verdicts.replace(margin=0.5)  # as of eight runs a third may fail, unseen
    study = CLAIMED.replace(tasks=("face_direction",), seeds=tuple(range(8)), verdicts=claims)
    with of_a_commit():
        register_study(Plan(study, folder))
    make_runs(Plan(study, folder), study.seeds)
    write_policies(folder, study)
    write_tables(folder)
    return folder


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip("playwright.sync_api")
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("no Chromium")
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--disable-gpu"]
        )
        yield opened
        opened.close()


@pytest.fixture
def page(browser, whole):
    """The report's page with the network cut off; what it logs and asks for is kept."""
    opened = browser.new_page(offline=True, color_scheme="light")
    opened.said, opened.asked = [], []
    opened.on("console", lambda message: opened.said.append(message.text))
    opened.on("pageerror", lambda error: opened.said.append(str(error)))
    opened.on("request", lambda request: opened.asked.append(request.url))
    opened.goto((whole / PAGE).resolve().as_uri())
    yield opened
    opened.close()


def test_it_loads_alone_and_without_errors(page):
    assert page.said == []
    assert [url for url in page.asked if not url.startswith(("data:", "file:"))] == []
    assert len([url for url in page.asked if url.startswith("file:")]) == 1
    assert page.title() == "a-study: report"  # the reason of the failed run didn't run
    assert TRAP in page.locator("#runs").inner_text()


def test_every_figure_shows_in_light_and_dark(page):
    shown = page.locator("figure img.light")
    assert shown.count() == 8
    for theme in ("light", "dark"):
        for image in page.locator(f"figure img.{theme}").all():
            assert image.is_visible()
            assert image.evaluate("image => image.decode().then(() => image.naturalWidth)") > 100
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(255, 255, 255)") == (theme == "light")
        page.locator("#theme").click()


def test_a_figure_can_be_enlarged(page):
    small = page.locator("figure img.light").first.bounding_box()["width"]
    page.locator(".zoom").first.click()
    stage = page.locator("#stage img")
    fitting = stage.bounding_box()["width"]
    assert fitting > small
    page.get_by_role("button", name="larger").click()
    assert stage.bounding_box()["width"] == pytest.approx(1.25 * fitting, rel=0.01)
    page.locator("#close").click()
    assert not page.locator("#viewer").is_visible()


def test_tables_sort_by_number_and_by_name(page):
    table = page.locator("#answer table").first

    def column(i):
        return table.locator(f"tbody tr td:nth-child({i})").all_inner_texts()

    assert column(1) == ["full", "dae-8", "pca-8", *POLICIES]
    head = table.locator("th").nth(3)  # final return, as 812 [780, 844]
    head.click()
    ascending = [float(text.split()[0]) for text in column(4)]
    assert ascending == sorted(ascending)
    assert head.get_attribute("aria-sort") == "ascending"
    head.click()
    assert [float(text.split()[0]) for text in column(4)] == ascending[::-1]
    table.locator("th").first.click()
    assert column(1) == sorted(["dae-8", "full", "pca-8", *POLICIES])


def test_text_stands_left_and_numbers_right(page):
    def alignments(table):
        cells = page.locator(f"{table} tbody tr").first.locator("td").all()
        return [cell.evaluate("cell => getComputedStyle(cell).textAlign") for cell in cells]

    right = ["right"]
    assert alignments("#answer .wide >> nth=0 >> table") == ["left", *3 * right, "left", *2 * right]
    assert alignments("#tables .wide >> nth=0 >> table") == ["left"] + 8 * right


def test_a_column_of_numbers_may_have_intervals_and_dashes():
    rows = [("1,190", "-3 [-4, 2]", "> 320", "- (0/5)", "1e-05", "dae-8", "7dd50d17"), ("-",) * 7]
    assert Table("", ("",) * 7, rows).numeric == [True] * 5 + [False] * 2


def test_the_answer_comes_first_and_nothing_is_judged_that_was_not_registered(page):
    lead = page.locator("#answer .lead").all_inner_texts()
    assert lead[0].startswith("face_direction, sac, final returns: full 798, pca-8 830, dae")
    assert (
        "; policies that don't look: standing still 260, constant drive 247, random 110; "
        "hand-written 950. " in lead[0]
    )
    assert lead[0].endswith("Learned: full, pca-8; didn't: dae-8.")
    assert (
        lead[1]
        == "With 4 runs of each and no claim registered, this is exploratory: no conclusion."
    )
    kinds = page.locator("#answer > *").evaluate_all("all => all.map(each => each.tagName)")
    assert kinds == ["P", "P", "FIGURE", "H3", "DIV"]
    assert page.locator("#verdicts").count() == 0
    tables = page.locator("#tables").inner_text()
    assert "face_direction, sac, compared with full" in tables
    assert re.search(r"\d (later|earlier) \[", tables)


def test_it_can_be_read_on_a_telephone(page):
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for figure in page.locator(".zoom").all():
        image = figure.locator("img.light")
        width = image.bounding_box()["width"]
        assert width >= image.evaluate("image => image.naturalWidth") - 1  # as on paper
        assert figure.evaluate("button => button.scrollWidth") >= width  # none is out of reach
    for each in page.locator(".wide, .zoom, nav, pre").all():  # what is cut says that it scrolls
        is_cut = each.evaluate("each => each.scrollWidth > each.clientWidth + 1")
        said = each.evaluate("each => getComputedStyle(each, '::before').content")
        assert said == ('"scroll →"' if is_cut else "none")


def test_it_prints(page):
    page.locator("#theme").click()  # prints light all the same
    assert page.pdf(format="A4").startswith(b"%PDF")
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()


def test_verdicts_are_the_same_wherever_they_are_told(judged, tmp_path):
    """On the page, in the summaries and in the statistics."""
    page, summary, text, statistics = (tmp_path / n for n in (PAGE, SUMMARY, MARKDOWN, STATISTICS))
    tables = read_tables(judged)
    write_report(tables, tmp_path)
    told, verdicts = json.loads(summary.read_text()), tables.analysis.verdicts
    assert [each["verdict"] for each in told["verdicts"]] == [each.verdict for each in verdicts]
    assert {each["verdict"] for each in told["verdicts"]} == {"supported", "undecided"}
    (group,) = json.loads(statistics.read_text())["groups"]
    assert group["verdicts"] == told["verdicts"]
    (table,) = verdict_tables(tables.analysis)
    assert [row[0] for row in table.rows] == [*tables.record.study.verdicts.claims]
    section = html.unescape(page.read_text()).partition('<section id="verdicts">')[2]
    section = section.partition("</section>")[0]
    for row in table.rows:
        assert f"| {' | '.join(row)} |".replace("<", r"\<") in text.read_text()
        assert all(f">{cell}</td>" in section for cell in row)


def test_the_markdown_shows_verdicts_numbers_and_a_figure_that_is_there(whole):
    text = (whole / MARKDOWN).read_text()
    assert text.startswith("# a-study\n")
    order = ("**face_direction, sac, final returns: full", "**With 4 runs", "![", "| agents on |")
    assert [text.index(each) for each in order] == sorted(text.index(each) for each in order)
    (figure,) = re.findall(r"!\[.*\]\((.*)\)", text)
    assert (whole / figure).exists()
    assert "| full | 4 | - |" in text
    assert "> 1 run is counted as return 0, the least possible, from the step of failure" in text
    assert "face_direction, sac, compared with full:" in text
    assert re.search(r"\n\| standing still \| .* \| 260 \[", text)
    summary = json.loads((whole / SUMMARY).read_text())
    assert summary["failed"] == [["face_direction/sac/dae-8", "0"]]
    mean = summary["numbers"]["face_direction/sac/full"]["final_return_mean"][0]
    assert f"| full | 4 | - | {mean:.0f} [" in text


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("face_direction: 812 [780, 844], 5 %", "face_direction: 812 [780, 844], 5 %"),
        ("a|b `c` *d* _e_ <f> ~g~ h\\", r"a\|b \`c\` \*d\* \_e\_ \<f> \~g\~ h\\"),
        ("two\nlines\r\n# head", r"two lines \# head"),
        ("![x](y) [x][y] [x]: y", r"\![x\](y) [x\][y\] [x\]: y".replace(r"y\]", "y]")),
        ("&lt; R&D", r"\&lt; R\&D"),
        ("- item", r"\- item"),
        ("12. item", r"12\. item"),
    ],
)
def test_nothing_in_a_name_is_markup(text, escaped):
    assert escape(text) == escaped


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


def test_markdown_keeps_its_tables_whatever_the_names(whole, tmp_path):
    named_otherwise(whole, tmp_path / "a|b*", "mine")
    tables = read_tables(tmp_path / "a|b*")
    text = markdown(tables, [], "figure.png")
    assert text.startswith("# a\\|b\\*\n")
    assert "| mine | 4 | 1 |" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {8, 11}
    assert not re.search(r"(?<!\\)[<`]", text)


def test_diagnostics_are_set_against_returns_where_they_are_known(whole, tmp_path, monkeypatch):
    """As a table of the page and of the summary, and as a figure."""
    named_otherwise(whole, tmp_path / "study", "dae-8")
    rows = [
        Diagnosed("face_direction", name, "0", {"forward": 0.1 * i}) for i, name in enumerate(FINAL)
    ]
    (tmp_path / "study" / DIAGNOSTICS).write_text(diagnostics_text(rows))
    adopt(tmp_path / "study" / RECORD, DIAGNOSTICS)
    plots = []
    monkeypatch.setattr(report, "study_plots", lambda *parts: plots.extend(study_plots(*parts)))
    monkeypatch.setattr(report, "page", lambda *parts: page_of(parts[0], [], *parts[2:]))
    monkeypatch.setattr(report, "write", lambda *_: [])
    page, _, text, *_ = write_report(read_tables(tmp_path / "study"), tmp_path / "study")
    assert "diagnostics" in [plot.name for plot in plots]
    row = ("forward", SCALARS["forward"].words, "-", "3")  # three codes are too few to correlate
    assert f"| {' | '.join(row)} |" in text.read_text()
    assert "do diagnostics predict learning?" in page.read_text()
    assert "do diagnostics predict learning?" not in (whole / PAGE).read_text()


def test_names_that_are_not_utf_8_are_written_all_the_same(whole, tmp_path):
    folder = Path(f"{tmp_path}/studi\udce9")  # as Linux gives a folder named in Latin-1
    copy_tables(whole, folder)
    page, summary, text, *_ = write_report(read_tables(folder), folder)
    assert "<h1>studi?</h1>" in page.read_text()
    assert json.loads(summary.read_text())["study"] == "studi?"
    assert text.read_text().startswith("# studi?\n")


def test_it_can_be_made_from_the_tables_alone(whole, tmp_path):
    alone = tmp_path / "a-study"
    copy_tables(whole, alone)
    write_report(read_tables(alone), alone)
    assert_same_files(alone, whole, PAGE, SUMMARY, MARKDOWN, STATISTICS)
    figures = [{f.name: f.read_bytes() for f in (d / FIGURES).iterdir()} for d in (alone, whole)]
    assert figures[0] == figures[1]


def test_the_page_says_how_to_reproduce_it(whole):
    text = (whole / PAGE).read_text().replace("&#34;", '"')
    for line in (
        'representations = [\n    "full",\n    "dae-8",\n    "pca-8",\n]',
        "seeds = [\n    0,\n",
        "jbrep study study.toml --out a-study",
        "torch==2.13.0",
        "a processor",
    ):
        assert line in text


def test_runs_without_a_study_are_made_again_each_in_a_folder_of_its_own(whole):
    tables = read_tables(whole)
    labels = tables.record.labels
    other = labels["face_direction/sac/full"]
    cheetah = {
        **labels,
        "dm_control/cheetah-run-v0/sac/full": other.replace(
            settings=other.settings.replace(
                task="dm_control/cheetah-run-v0",
                environment=other.settings.environment.replace(name="dm_control/cheetah-run-v0"),
            )
        ),
    }
    tables = tables._replace(record=tables.record.replace(labels=cheetah, study=None))
    _, *columns = setting_table(tables).header
    assert columns == ["face_direction/sac", "dm_control/cheetah-run-v0/sac"]
    typed = [line for _, code in reproduce(tables) for line in code.splitlines()]
    folders = [line.split()[-1] for line in typed if line.startswith("jbrep rl")]
    assert sorted(folders) == sorted(
        f"a-study/{label.replace('dm_control/', 'dm_control-')}/seed-0" for label in cheetah
    )


def test_a_run_that_saw_less_is_made_again_with_as_little(whole):
    tables = read_tables(whole)
    label, shared = next(iter(tables.record.labels.items()))
    seen = with_view(describe("face_direction"), ["velocity_*"], 2).replace(missing="skip")
    settings = shared.settings.replace(task=seen.name, environment=seen)
    labels = {**tables.record.labels, label: shared.replace(settings=settings)}
    record = tables.record.replace(labels=labels, study=None)
    code = [code for _, code in reproduce(tables._replace(record=record))][1]
    hidden = " ".join(f"--hide velocity_{axis}" for axis in "xyz")
    assert "--task face_direction --" in code
    assert f"{hidden} --history 2 --missing skip" in code


def test_no_line_to_copy_runs_what_a_stranger_wrote(whole, tmp_path):
    tables, trap = read_tables(whole), "$(touch trap); touch trap #"
    label, shared = next(iter(tables.record.labels.items()))
    settings = shared.settings.replace(
        environment=shared.settings.environment.replace(arguments={"file": trap}),
        overrides={"net_arch": trap},
    )
    labels = {**tables.record.labels, label: shared.replace(settings=settings)}
    for study in (None, STUDY):
        record = tables.record.replace(labels=labels, study=study)
        for _, code in reproduce(tables._replace(name=trap, record=record)):
            if code.startswith(("jbrep ", "pip ")):
                script = f"jbrep() {{ :; }}; pip() {{ :; }}; {code}"
                subprocess.run(["sh", "-c", script], cwd=tmp_path, check=True)
    assert not list(tmp_path.iterdir())


def test_where_nothing_was_compared_the_answer_says_so(whole):
    analysis = read_tables(whole).analysis
    (group,) = analysis.groups
    alone = replace(group, labels=group.labels[:1], comparisons=())
    alone = replace(analysis, groups=(alone,))
    told = answer(read_tables(whole)._replace(analysis=alone))
    assert told[-1] == "Nothing was compared with full."


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
    rows = dict(row[:2] for row in setting_table(tables).rows)
    assert (rows["tau"], rows["overrides"]) == ("one of 0.01, 0.02, by seed", "-")
    assert as_study(tomllib.loads(tables.record.study.toml())) == DRAWN


def test_a_report_compares_with_the_study_s_baseline(whole, tmp_path):
    copy_tables(whole, tmp_path)
    record = read_document(tmp_path / RECORD, RunsRecord)
    against = record.study.replace(verdicts=Rules(baseline="pca-8"))
    record.replace(study=against).write(tmp_path / RECORD)
    tables = read_tables(tmp_path)
    told = markdown(tables, [], "figure.png")
    assert "of pca-8's gain" in told
    assert "compared with pca-8" in told
    assert "full's" not in told


def test_the_table_of_returns_says_what_its_shares_are_of(whole):
    tables = read_tables(whole)
    won = [
        RunInfo("face_direction", "sac", "full", seed, 2000, episode, "won", 1.0)
        for seed in STUDY.seeds
        for episode in range(2)
    ]
    (table,) = returns_tables(tables._replace(infos=won))
    assert "share of won" in table.header
    assert table.title.endswith("; shares of episodes leave out runs that failed")
    (group,) = tables.analysis.groups
    comparisons = [replace(each, by_encoder=True) for each in group.comparisons]
    groups = (replace(group, comparisons=comparisons),)
    (table,) = returns_tables(tables._replace(analysis=replace(tables.analysis, groups=groups)))
    assert table.title.endswith("of 8 encoders or more, intervals are over encoders")
    assert "a score of 0 is standing still 260, 1 is hand-written 950" in table.title


def test_where_the_baseline_did_not_learn_nothing_is_compared(whole, tmp_path):
    copy_tables(whole, tmp_path / "idle")
    path = tmp_path / "idle" / REFERENCE_RETURNS
    path.write_text(re.sub(r"(random,\d+),.*", r"\1,900", path.read_text()))
    adopt(tmp_path / "idle" / RECORD, REFERENCE_RETURNS)
    told = markdown(read_tables(tmp_path / "idle"), [], "figure.png")
    assert "Learned" not in told
    assert "**Agents on full didn't learn: nothing" in told
    assert "of full's gain" not in told
    assert "compared with full:" not in told


def test_two_runs_of_one_label_and_seed_are_not_one(tmp_path):
    plan = make_study(tmp_path / "study")
    first = plan.folder_of(plan.cells[0])
    shutil.copytree(first, tmp_path / "runs" / "a")
    shutil.copytree(first, tmp_path / "runs" / "b")
    said = mistake("report", tmp_path / "runs")
    assert "runs/a and " in said
    assert f"runs/b are both seed 0 of {plan.cells[0].label}: put runs that differ" in said


@pytest.mark.usefixtures("one_figure")
def test_an_unfinished_study_says_what_is_missing(tmp_path):
    plan = make_study(tmp_path / "half", left=5)
    (plan.folder_of(plan.cells[-1])).mkdir(parents=True)
    (plan.folder_of(plan.cells[-1]) / "progress").write_text("700 12")
    write_tables(plan.folder)
    write_report(read_tables(plan.folder), plan.folder)
    summary = json.loads((plan.folder / SUMMARY).read_text())
    assert summary["missing"] == [cell.name for cell in plan.cells[-5:]]
    assert summary["runs"] == 7
    text = (plan.folder / PAGE).read_text()
    assert "This study is unfinished: 5 runs are missing" in text
    assert "700</td>" in text
    assert "With 2 to 3 runs of each" in text


def test_of_single_runs_it_shows_what_there_is(tmp_path):
    plan = make_study(tmp_path / "young", left=9)  # a run of each representation
    write_tables(plan.folder)
    write_report(read_tables(plan.folder), plan.folder)
    assert not (plan.folder / STATISTICS).exists()
    text = (plan.folder / PAGE).read_text()
    assert "dae-8: one run has ended, at least two are needed" in text
    assert "There are no statistics yet" in text
    assert text.count("<figure") == 3
    assert (plan.folder / FIGURES / "every_run.png").exists()


def test_two_reports_of_a_folder_take_turns(whole, tmp_path, monkeypatch):
    copy_tables(whole, tmp_path)
    events = []

    def write(tables, out):
        events.append("begun")
        time.sleep(0.3)  # in which the other would begin
        events.append("ended")
        return []

    monkeypatch.setattr(report, "write_report", write)
    with ThreadPoolExecutor() as pool:
        list(pool.map(make_report, [tmp_path] * 2))
    assert events == ["begun", "ended"] * 2


def test_references_are_played_once_on_the_starts_of_evaluation(tmp_path, monkeypatch):
    tasks = [(describe("face_direction", max_episode_steps=50), 2)]
    sha256 = write_references(tasks, tmp_path, {})
    path = tmp_path / REFERENCE_RETURNS
    rows = list(csv.reader(path.read_text().splitlines()))
    assert rows[0] == ["task", "policy", "episode", "return"]
    policies = {"standing still": "still", "constant drive": "constant:drive=0.75"}
    policies |= {"random": "uniform", "hand-written": "heuristic"}
    assert [row[1] for row in rows[1:]] == [name for name in policies for _ in range(2)]
    for _, name, episode, played in rows[1:]:
        alone = find_episode(policies[name], int(episode), tasks[0][0]).reward.sum()
        assert float(played) == pytest.approx(alone, abs=1e-3)
    monkeypatch.setattr("jbrep.study.tables.find_player", None)
    assert write_references(tasks, tmp_path, {}) == sha256
    monkeypatch.undo()
    longer = tasks[0][0].replace(max_episode_steps=60)
    assert write_references([(longer, 2)], tmp_path, {}, {longer.name: tasks[0][0]}) != sha256
    assert write_references(tasks, tmp_path, {}, {longer.name: longer}) == sha256
    path.write_text(path.read_text().replace(",1,", ",1,1"))  # what is another is played again
    assert write_references(tasks, tmp_path, {REFERENCE_RETURNS: sha256}) == sha256


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("runs.json", lambda text: text[:100], "runs.json is damaged, or not a jbrep runs file"),
        ("runs.json", lambda text: "[]", "runs.json is damaged, or not a jbrep runs file"),
        ("runs.json", lambda text: text.replace("60.0", "NaN"), "runs.json is damaged"),
        ("runs.json", lambda text: text.replace("60.0", "1e999"), "runs.json is damaged"),
        ("runs.json", lambda text: text.replace('"seed"', '"sead"'), "unknown runs.0..sead"),
        ("runs.json", lambda text: text.replace('"2.13.0', '"2; touch P #'), "must be a version"),
        ("runs.json", lambda text: text.replace('"failed"', '"lost"'), "is .lost.: it must"),
        (
            "runs.json",
            lambda text: text.replace('"size": 16', '"size": -1'),
            "encoder.size must be",
        ),
        (
            "runs.json",
            lambda text: text.replace('"label": "face_direction', '"label": "turn'),
            "settings of turn/sac/full are missing",
        ),
        (
            "runs.json",
            lambda text: text.replace('version": 3', 'version": 2'),
            "this jbrep reads version 3 alone",
        ),
        ("returns.csv", lambda text: text.replace("full,3,1000", "full,3,0"), "differ in their ep"),
        ("returns.csv", lambda text: text.replace("full,3,", "full,9,"), "of evaluations is 0"),
        ("returns.csv", lambda text: text[:-1] + ",", "returns.csv is damaged or cut short"),
        ("returns.csv", lambda text: text + f"a,b,c,0,{10**30},0,1\n", "returns.csv is damaged or"),
        ("returns.csv", lambda text: text + "a,b,c,0,0,0,nan\n", "returns.csv is damaged or"),
        ("returns.csv", lambda text: text + "a,b,c,0,0,0,1e101\n", "returns.csv is damaged or"),
        ("returns.csv", lambda text: text + '"' + "a" * 200_000, "returns.csv is damaged or"),
        ("references.csv", lambda text: text + "x", "references.csv is damaged or cut short"),
        ("references.csv", lambda text: b"\xff", "references.csv is damaged or cut short"),
        ("returns.csv", None, r"can't read .*returns\.csv"),
        ("runs.json", None, "is not the folder of a study: it has neither runs nor a runs.json"),
    ],
)
def test_damaged_tables_are_refused(name, change, message, whole, tmp_path):
    copy_tables(whole, tmp_path)
    path = tmp_path / name
    if change is None:
        path.unlink()
    else:
        changed = change(path.read_text())
        path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
        with suppress(ValueError, TypeError):
            adopt(tmp_path / "runs.json", *TABLES[1:])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match=message):
        write_report(read_tables(tmp_path), tmp_path)
    assert sorted(tmp_path.iterdir()) == before


ODD = (None, True, -1, 0.5, 10**30, "", "x", [], {}, [None], {"x": None})


def change_one(value, choose):
    """A copy of a JSON value with one part, anywhere, replaced or removed."""
    if isinstance(value, dict | list) and value and choose.random() < 0.85:
        key = choose.choice(list(value) if isinstance(value, dict) else range(len(value)))
        changed = value.copy()
        if choose.random() < 0.1:
            del changed[key]
        else:
            changed[key] = change_one(value[key], choose)
        return changed
    return choose.choice(ODD)


def test_changed_tables_are_refused_or_shown(whole, tmp_path, monkeypatch):
    """Whatever is read can be put into words; figures are left out here, as they take long."""
    copy_tables(whole, tmp_path)
    monkeypatch.setattr(report, "study_plots", lambda *tables: [])
    record = json.loads((whole / "runs.json").read_text())
    choose, refused = random.Random(0), []
    for _ in range(150):
        changed = change_one(record, choose)
        with suppress(AttributeError):
            forge(tmp_path / "runs.json", changed)
        try:
            write_report(read_tables(tmp_path), tmp_path)
        except InputError as error:
            refused.append(str(error))
    assert 50 < len(refused) < 150
    assert not any("\n" in message for message in refused)


def test_a_run_of_a_newer_jbrep_is_named(tmp_path):
    plan = make_study(tmp_path / "new", left=11)
    path = plan.folder_of(plan.cells[0]) / "run.json"
    path.write_text(path.read_text().replace('version": 5', 'version": 7'))
    with pytest.raises(InputError, match=r"run\.json has version 7 of the jbrep run format"):
        write_tables(plan.folder)


@pytest.mark.parametrize("study", ["ablation-speed", "breadth", "cheetah", "confirm", "longer"])
def test_committed_results_are_those_of_their_tables(study, tmp_path, monkeypatch):
    """Statistics and summaries come from the tables anew, the same to the byte but for rounding."""
    folder = Path("results") / study
    monkeypatch.setattr(report, "study_plots", lambda *tables: [])
    monkeypatch.setattr(report, "page", lambda *tables: "")
    write_report(read_tables(folder), tmp_path)
    assert (tmp_path / MARKDOWN).read_text() == (folder / MARKDOWN).read_text()
    ours, theirs = (json.loads((each / STATISTICS).read_text()) for each in (tmp_path, folder))
    check_close(ours, theirs)


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


def test_a_report_says_how_the_full_state_was_scaled():
    """The referee of a comparison wants to know whether codes differ by more than a reduction."""
    said = {
        name: full_scaling(read_tables(Path("results") / name))
        for name in ("confirm-move", "breadth")
    }
    assert said == {
        "confirm-move": "The full state is scaled by extrema of 4,000,000 states, codes are made "
        "of 80,000: so they differ by more than what they leave out.",
        "breadth": "The full state is scaled by extrema of 4,000,000 states.",
    }
