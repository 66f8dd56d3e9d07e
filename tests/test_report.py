"""A report is whole by itself, says what the tables say, and refuses what isn't one."""

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from jbrep.encoders import find, save
from jbrep.errors import InputError
from jbrep.figures import write
from jbrep.files.tables import write_csv
from jbrep.report import report, write_report
from jbrep.report.facts import reproduce
from jbrep.report.report import FIGURES, MARKDOWN, PAGE, SUMMARY
from jbrep.report.tables import read_tables
from jbrep.report.words import answers
from jbrep.rl.files import ENCODER, Evaluation, write_rows, write_run
from jbrep.rollouts.sources import find_episode
from jbrep.study.config import Study, read_study
from jbrep.study.heuristics import HEURISTIC_RETURNS, write_heuristics
from jbrep.study.plan import Plan
from jbrep.study.results import read_results, write_results
from jbrep.text import SIGNIFICANT, number

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
)
TRAP = "<script>document.title = 'run'</script>"


def write_a_run(plan, cell, failed=False, reason=TRAP):
    """A run's files as jbrep rl leaves them, with returns made up."""
    folder = plan.folder_of(cell)
    folder.mkdir(parents=True)
    run, encoder = plan.run(cell), find(plan.run(cell).encoder, cell.task)
    save(encoder, folder / ENCODER)
    random = np.random.default_rng([cell.seed, len(cell.representation.name)])
    final = FINAL[cell.representation.name] + random.normal(0, 30)
    rows = [
        Evaluation(step, episode, float(np.clip(mean + random.normal(0, 5), 0, 1000)))
        for step, mean in ((0, 100), (1000, final / 2), (2000, final))
        for episode in range(2)
    ]
    write_rows(folder / "evaluations.csv", rows[: 4 if failed else 6], Evaluation)
    result = {
        "status": "failed" if failed else "finished",
        **({"reason": reason} if failed else {}),
        "settings": run.describe(encoder),
        "steps": 1500 if failed else 2000,
        "seconds": 60.0,
        "versions": {"jbrep": "0.1.0", "torch": "2.13.0+cpu"},
        "cpu": "a processor",
    }
    write_run(folder, result)


def make_study(folder, left=0, failed=()):
    plan = Plan(STUDY, folder)
    plan.begin()
    for i, cell in enumerate(plan.cells[: len(plan.cells) - left]):
        write_a_run(plan, cell, failed=i in failed)
    return plan


def conclude(folder):
    write_results(read_results(folder), folder)
    return write_report(folder)


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
    rows = [("face_direction", episode, 940 + episode) for episode in range(20)]
    write_csv(folder / HEURISTIC_RETURNS, ("task", "episode", "return"), rows)
    conclude(folder)
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
    assert shown.count() == 9
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
    table = page.locator("#tables table").first

    def column(i):
        return table.locator(f"tbody tr td:nth-child({i})").all_inner_texts()

    assert column(1) == ["full", "dae-8", "pca-8"]
    head = table.locator("th").nth(3)  # final return, as 812 [780, 844]
    head.click()
    ascending = [float(text.split()[0]) for text in column(4)]
    assert ascending == sorted(ascending)
    assert head.get_attribute("aria-sort") == "ascending"
    head.click()
    assert [float(text.split()[0]) for text in column(4)] == ascending[::-1]
    table.locator("th").first.click()
    assert column(1) == ["dae-8", "full", "pca-8"]


def test_it_prints(page):
    page.locator("#theme").click()  # prints light all the same
    assert page.pdf(format="A4").startswith(b"%PDF")
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()


def test_each_claim_has_its_verdicts_with_the_numbers_of_the_statistics(whole):
    summary = json.loads((whole / SUMMARY).read_text())
    statistics = json.loads((whole / "statistics.json").read_text())
    assert list(summary["claims"]) == ["similar reward", "less variance", "faster learning"]
    text = (whole / PAGE).read_text()
    for comparison in statistics["groups"][0]["comparisons"]:
        for verdict in comparison["verdicts"]:
            (found,) = [
                each
                for each in summary["claims"][verdict["claim"]]["verdicts"]
                if each["representation"] == comparison["representation"]
            ]
            assert found["verdict"] == verdict["verdict"]
            assert number(verdict["nominal"][0], SIGNIFICANT) in found["sentence"]
            assert found["sentence"].replace("'", "&#39;") in text.replace("&gt;", ">")
    similar = summary["claims"]["similar reward"]["counts"]
    assert sum(similar.values()) == 2
    assert summary["numbers"]["face_direction/sac/full"]["final_return_mean"][0] > 600
    assert summary["failed"] == [["face_direction/sac/dae-8", "0"]]


def test_the_markdown_shows_verdicts_numbers_and_a_figure_that_is_there(whole):
    text = (whole / MARKDOWN).read_text()
    assert text.startswith("# a-study\n")
    assert "**The reduced state ends at a similar reward:" in text
    (figure,) = re.findall(r"!\[.*\]\((.*)\)", text)
    assert (whole / figure).exists()
    assert "| full | 4 | 0 |" in text
    assert "> 1 run is counted as return 0" in text


def test_it_can_be_made_from_the_tables_alone(whole, tmp_path):
    tables = ("runs.json", "returns.csv", "statistics.json", "heuristics.csv")
    alone = tmp_path / "a-study"
    alone.mkdir()
    for name in tables:
        shutil.copy(whole / name, alone / name)
    write_report(alone)
    for name in (PAGE, SUMMARY, MARKDOWN):
        assert (alone / name).read_bytes() == (whole / name).read_bytes()
    figures = [{f.name: f.read_bytes() for f in (d / FIGURES).iterdir()} for d in (alone, whole)]
    assert figures[0] == figures[1]


def test_the_page_says_how_to_reproduce_it(whole):
    text = (whole / PAGE).read_text().replace("&#34;", '"')
    for line in (
        'representations = ["full", "dae-8", "pca-8"]',
        "seeds = [0, 1, 2, 3]",
        "jbrep study study.toml --out a-study",
        "torch==2.13.0",
        "a processor",
    ):
        assert line in text


def test_runs_without_a_study_are_made_again_each_in_a_folder_of_its_own(whole):
    tables = read_tables(whole)
    labels = tables.record["labels"]
    labels["move_to_pose/sac/full"] = labels["face_direction/sac/full"]
    tables.record["study"] = None
    typed = [line for _, code in reproduce(tables) for line in code.splitlines()]
    folders = [line.split()[-1] for line in typed if line.startswith("jbrep rl")]
    assert sorted(folders) == sorted(f"a-study/{label}/seed-0" for label in labels)


def test_where_nothing_was_compared_no_verdict_is_missing():
    (similar, *_) = answers({"groups": [{"comparisons": []}]})
    assert similar.headline.endswith("at a similar reward: no reduced state was compared")


def test_an_unfinished_study_says_what_is_missing(tmp_path):
    plan = make_study(tmp_path / "half", left=5)
    (plan.folder_of(plan.cells[-1])).mkdir(parents=True)
    (plan.folder_of(plan.cells[-1]) / "progress").write_text("700 12")
    conclude(plan.folder)
    summary = json.loads((plan.folder / SUMMARY).read_text())
    assert summary["missing"] == [cell.name for cell in plan.cells[-5:]]
    assert summary["runs"] == 7
    text = (plan.folder / PAGE).read_text()
    assert "This study is not finished: 5 runs are missing" in text
    assert "700</td>" in text
    assert "supported" in text  # of what two runs are there


def test_of_single_runs_it_shows_what_there_is(tmp_path):
    plan = make_study(tmp_path / "young", left=9)  # a run of each representation
    conclude(plan.folder)
    assert not (plan.folder / "statistics.json").exists()
    text = (plan.folder / PAGE).read_text()
    assert "dae-8: one run is over, two are needed" in text
    assert "There are no statistics yet" in text
    assert text.count("<figure") == 3
    assert (plan.folder / FIGURES / "every_run.png").exists()


def test_heuristics_are_played_once_on_the_starts_of_evaluation(tmp_path, monkeypatch):
    monkeypatch.setattr("jbrep.study.heuristics._EPISODES", 4)
    rows = list(csv.reader(write_heuristics(STUDY.tasks, tmp_path).read_text().splitlines()))
    assert rows[0] == ["task", "episode", "return"]
    assert len(rows) == 1 + 4
    alone = find_episode("heuristic", 3, "face_direction").reward.sum()
    assert float(rows[4][2]) == pytest.approx(alone, abs=1e-3)
    monkeypatch.setattr("jbrep.study.heuristics.episode_returns", None)
    write_heuristics(STUDY.tasks, tmp_path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("runs.json", lambda text: text[:100], "runs.json is damaged, or no jbrep runs"),
        ("runs.json", lambda text: "[]", "runs.json is damaged, or no jbrep runs"),
        ("runs.json", lambda text: text.replace('version": 1', 'version": 2'), "newer one is need"),
        (
            "statistics.json",
            lambda text: text.replace('version": 1', 'version": 2'),
            "statistics.json has format version 2: this jbrep reads up to 1",
        ),
        ("statistics.json", lambda text: text.replace('"grid"', '"gird"'), "don't fit together"),
        ("returns.csv", lambda text: text[:-1] + ",", "returns.csv is damaged, or cut short"),
        ("heuristics.csv", lambda text: text + "x", "heuristics.csv is damaged, or cut short"),
        ("returns.csv", None, "returns.csv"),
        ("runs.json", None, "is not of a study: runs below it are expected, or a runs.json"),
    ],
)
def test_tables_that_are_none(name, change, message, whole, tmp_path):
    for each in ("runs.json", "returns.csv", "statistics.json", "heuristics.csv"):
        shutil.copy(whole / each, tmp_path / each)
    path = tmp_path / name
    if change is None:
        path.unlink()
    else:
        path.write_text(change(path.read_text()))
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match=message):
        write_report(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


def test_a_run_of_a_newer_jbrep_is_named(tmp_path):
    plan = make_study(tmp_path / "new", left=11)
    path = plan.folder_of(plan.cells[0]) / "run.json"
    path.write_text(path.read_text().replace('version": 1', 'version": 7'))
    with pytest.raises(InputError, match=r"run\.json has format version 7: this jbrep reads up"):
        read_results(plan.folder)


@pytest.mark.parametrize("study", ["ddpg", "desk", "yaw"])
def test_committed_results_are_of_the_study_that_made_them(study):
    tables = read_tables(Path("results") / study)
    planned = Plan(read_study(Path("studies") / f"{study}.toml"), Path())
    names = {f"{run['label']}/seed-{run['seed']}" for run in tables.record["runs"]}
    assert names | set(tables.record["missing"]) == {cell.name for cell in planned.cells}
    assert names == {
        f"{row.task}/{row.algorithm}/{row.representation}/seed-{row.seed}" for row in tables.returns
    }
