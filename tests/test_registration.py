"""Studies whose plan is written down before the first run, and held against what ran."""

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from command import in_this_process, jbrep
from made_up import COMMITS, of_a_commit
from small import forge
from test_study import TINY, written

from jbrep.encoders import load
from jbrep.errors import InputError
from jbrep.records.document import read_document
from jbrep.report.tables import read_tables
from jbrep.rl.files import RUN, read_run, runs_below
from jbrep.stats.scale import CONSTANT, STILL
from jbrep.study.config import Data, read_study
from jbrep.study.plan import Plan
from jbrep.study.record import RECORD, RunsRecord
from jbrep.study.registration import REGISTRATION, read_registration
from jbrep.study.results import write_tables
from jbrep.study.runner import register_study, run_study
from jbrep.study.tables import REFERENCE_RETURNS

ROOT = Path(__file__).parent.parent
TINIER = TINY.replace(representations=("full",), seeds=(0, 1))


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """A study that was registered, and has run since."""
    folder = tmp_path_factory.mktemp("registered") / "study"
    with of_a_commit():
        register_study(Plan(TINIER, folder))
        assert run_study(Plan(TINIER, folder), in_this_process, 1) == 0
    write_tables(folder)
    return Plan(TINIER, folder)


def test_a_plan_is_written_down(tmp_path):
    command = ("study", written(tmp_path), "--out", tmp_path / "out", "--register")
    told = jbrep(*command)
    assert told.exit_code == 0, told.output
    registration = read_registration(tmp_path / "out")
    assert registration.sha256 in told.output
    assert str(tmp_path / "out" / REGISTRATION) in told.output
    assert registration.study["seeds"] == [0, 1]
    assert registration.versions.keys() >= {"jbrep", "torch", "stable-baselines3"}
    assert not list((tmp_path / "out").rglob(RUN))
    assert jbrep(*command).exit_code == 0  # the same once more
    assert read_registration(tmp_path / "out") == registration


def test_encoders_that_the_study_makes_are_registered_by_their_hashes(tmp_path):
    """So it is told if other ones ran, as of data or by code that changed since."""
    codes = ("pca-2", {"name": "random-2", "encoders": 2})
    study = TINIER.replace(
        representations=("full", *codes), data=Data(steps=1000), steps=16, evaluate_every=16
    )
    plan = Plan(study, tmp_path / "study")
    with of_a_commit():
        registration = register_study(plan)
    assert not list(plan.folder.rglob(RUN))
    made = {path.stem: load(path) for path in plan.encoders("face_direction").glob("*.safetensors")}
    assert registration.encoders == {
        f"face_direction/a2c/{code}/seed-{seed}": made[name].fingerprint
        for seed in (0, 1)
        for code, name in (
            ("full", "full"),
            ("pca-2", "pca-2"),
            ("random-2", f"random-2-s{seed}"),
        )
    }
    with of_a_commit():
        assert run_study(Plan(study, plan.folder), in_this_process, 1) == 0
    runs = [read_run(folder) for folder in runs_below(plan.folder)]
    assert registration.deviations(study, runs) == []
    name = runs[-1].settings.name
    other = registration.replace(encoders={**registration.encoders, name: "0" * 64})
    assert "1 of its runs have other encoders than were registered" in other.deviations(study, runs)


def test_what_ran_as_registered_says_so(registered):
    registration = registered.registration
    for path in registered.folder.rglob(RUN):
        assert json.loads(path.read_text())["settings"]["registration"] == registration.sha256
    told = jbrep("report", registered.folder)
    assert told.exit_code == 0, told.output
    page = (registered.folder / "report.html").read_text()
    assert f"SHA-256 {registration.sha256[:12]}: what ran is what was registered." in page
    assert "what ran is what was registered" in (registered.folder / "summary.md").read_text()


def test_a_changed_study_is_refused_but_for_new_seeds(registered):
    with pytest.raises(InputError, match=r"was changed: steps 80 \(now: 90\); put it back"):
        Plan(TINIER.replace(steps=90), registered.folder).write()
    with pytest.raises(InputError, match="was changed: representations"):
        Plan(TINY, registered.folder).write()
    Plan(TINIER.replace(seeds=(0, 1, 2)), registered.folder).write()
    Plan(TINIER, registered.folder).write()
    with pytest.raises(InputError, match="was changed: seeds"):
        Plan(TINIER.replace(seeds=(0,)), registered.folder).write()


def test_every_deviation_is_told(registered):
    registration, study = registered.registration, registered.study
    runs = [read_run(folder) for folder in runs_below(registered.folder)]
    assert registration.encoders.keys() == {run.settings.name for run in runs}
    assert registration.deviations(study, runs) == []
    one, other, *others = runs
    changed = (
        one.replace(
            settings=one.settings.replace(registration=None),
            versions={**one.versions, "torch": "2.0.0"},
            commits={"jbrep": "0" * 40},
        ),
        other.replace(settings=other.settings.replace(encoder="0" * 64)),
    )
    more = study.replace(seeds=(0, 1, 7), steps=81)
    assert registration.deviations(more, [*changed, *others]) == [
        "settings differ: steps 80 (now: 81)",
        "seeds were added, whose runs are exploratory: 7",
        "1 of its runs weren't made under this registration",
        "1 of its runs have other encoders than were registered",
        f"torch was 2.0.0, not {registration.versions['torch']}",
        "some runs were made by other commits of jbrep's code",
    ]


@pytest.mark.parametrize(
    ("commit", "told"),
    [
        (COMMITS["jbrep"], []),
        ("2" * 40, ["some runs were made by other commits of jbrep's code"]),
        (
            COMMITS["jbrep"] + "+changes",
            ["jbrep's code had changes that are in no commit, so it can't be compared"],
        ),
        (None, ["some of jbrep's code was of no known commit, so it can't be compared"]),
    ],
)
def test_code_that_cannot_be_compared_is_told(commit, told, registered):
    runs = [read_run(folder) for folder in runs_below(registered.folder)]
    runs[0] = runs[0].replace(commits={"jbrep": commit} if commit else {})
    found = registered.registration.deviations(registered.study, runs)
    assert found == told


def test_a_policy_that_came_later_changes_no_registered_study(tmp_path):
    """Gains count over the better of standing still and random actions, as was registered then."""
    folder = shutil.copytree(ROOT / "results" / "answer-face-direction", tmp_path / "study")
    path = folder / REFERENCE_RETURNS
    rows = [row for row in path.read_text().splitlines() if CONSTANT not in row]
    drive = [row.replace("standing still", CONSTANT).rsplit(",", 1) for row in rows[1:6]]
    assert all(CONSTANT in row for row, _ in drive)
    path.write_text("\n".join([*rows, *(f"{row},900.0" for row, _ in drive)]) + "\n")
    record = read_document(folder / RECORD, RunsRecord)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    record.replace(tables={**record.tables, REFERENCE_RETURNS: sha256}).write(folder / RECORD)
    (group,) = read_tables(folder).analysis.groups
    assert group.references[CONSTANT].value == 900
    assert group.reference_policy == STILL
    assert round(group.reference) == 251


def test_a_registration_that_is_gone_is_named(tmp_path):
    folder = shutil.copytree(ROOT / "results" / "answer-face-direction", tmp_path / "study")
    (folder / REGISTRATION).unlink()
    with pytest.raises(InputError, match=r"registration.json is missing: put it back"):
        read_tables(folder)


def test_a_registration_comes_first_and_stays_as_it_is(tmp_path):
    plan = Plan(TINIER, tmp_path / "late")
    register_study(plan)
    path = plan.folder / REGISTRATION
    path.write_text(path.read_text().replace('"steps": 80', '"steps": 81'))
    with pytest.raises(InputError, match="was changed after it was written"):
        read_registration(plan.folder)
    path.unlink()
    plan.folder_of(plan.cells[0]).mkdir(parents=True)
    (plan.folder_of(plan.cells[0]) / RUN).write_text("{}")
    with pytest.raises(InputError, match="has runs: a study is registered before its first run"):
        register_study(Plan(TINIER, plan.folder))


def test_a_registration_without_a_study_is_refused(registered, tmp_path):
    forge(tmp_path / REGISTRATION, {**registered.registration.as_json(), "study": {}})
    with pytest.raises(InputError, match=r"registration\.json is damaged .*study.tasks is missing"):
        read_registration(tmp_path)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "results").glob(f"*/{REGISTRATION}")), ids=lambda p: p.parent.name
)
def test_the_committed_results_are_of_the_studies_that_were_registered(path):
    registration = read_registration(path.parent)
    study = read_study(ROOT / "studies" / f"{path.parent.name}.toml")
    assert not registration.differences(study)
    record = read_document(path.with_name(RECORD), RunsRecord)
    assert record.registration.sha256 == registration.sha256
    assert not registration.differences(record.study)


def test_a_study_with_primary_cells_is_registered_when_it_begins(tmp_path):
    """Without a registration before the first run, there are no verdicts."""
    primary = {"primary": ["face_direction/a2c/pca-8"], "failing": 0.4}
    seeds = tuple(range(8))
    study = TINY.replace(seeds=seeds, steps=16, evaluate_every=16, verdicts=primary)
    plan = Plan(study, tmp_path / "study")
    assert run_study(plan, in_this_process, 1) == 0
    again = Plan(study, tmp_path / "study")
    judging = again.registration.registered.planned
    assert (judging.rules.primary, judging.seeds) == (tuple(primary["primary"]), seeds)
    for path in (tmp_path / "study").rglob(RUN):
        settings = json.loads(path.read_text())["settings"]
        assert settings["registration"] == again.registration.sha256
    (again.folder / REGISTRATION).unlink()
    assert Plan(study, tmp_path / "study").registration is None
