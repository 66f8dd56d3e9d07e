"""Studies whose plan is written down before the first run, and held against what ran."""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path
from unittest.mock import Mock

import pytest
from command import in_this_process, jbrep
from made_up import of_a_commit
from small import contents, settings, write_again
from test_study import TINY

from jbrep.collecting import collect
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST, read_manifest
from jbrep.encoders import find, load, save
from jbrep.envs import describe
from jbrep.errors import DamageError, InputError
from jbrep.records import commit as of_git
from jbrep.records.document import read_document
from jbrep.rl.files import RUN, read_run, runs_below
from jbrep.rl.policy_file import shipped_file
from jbrep.stats.rules import Rules
from jbrep.studies import runner
from jbrep.studies.config import Data, read_study
from jbrep.studies.plan import REGISTRATION, Plan, find_committed, registration_in, seal
from jbrep.studies.prepare import check, prepare
from jbrep.studies.record import RECORD, RunsRecord
from jbrep.studies.runner import register_study, run_study
from jbrep.studies.tables import write_tables

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


def git(folder, *arguments):
    """A command of git, as someone."""
    who = ("-c", "user.name=It", "-c", "user.email=it@it", "-c", "commit.gpgsign=false")
    given = ["git", "-C", str(folder), *who, *arguments]
    return subprocess.run(given, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "repository"
    folder.mkdir()
    git(folder, "init")
    return folder


def commit(folder):
    git(folder, "add", "-A")
    git(folder, "commit", "-m", "it")


CLAIMS = TINY.replace(
    seeds=tuple(range(8)),
    steps=40,
    evaluate_every=40,
    final_episodes=1,
    episode_steps=1,
    verdicts={"claims": ["pca-8 better than full"]},
)


def first_run(plan, cells, workers):
    """A backend that leaves the others out."""
    return in_this_process(plan, cells[:1], workers)


def test_a_plan_is_written_down(tmp_path):
    """Beside its file, at once: nothing is made."""
    study = TINIER.replace(
        representations=("full", "dae-8"), data={"": Data(steps=10**9, policy="trained")}
    )
    (tmp_path / "it.toml").write_text(study.toml())
    command = ("study", tmp_path / "it.toml", "--out", tmp_path / "out", "--register")
    told = jbrep(*command)
    assert told.exit_code == 0, told.output
    path = tmp_path / "it.registration.json"
    registration = registration_in(path)
    assert registration.sha256 in told.output
    assert str(path) in told.output
    assert registration.registered == study
    assert registration.encoders == {}
    sha256 = hashlib.sha256(shipped_file("face_direction").read_bytes()).hexdigest()
    assert registration.policies == {"data/face_direction/policy-0.safetensors": sha256}
    assert not registration.committed
    assert registration.versions.keys() >= {"jbrep", "torch", "stable-baselines3"}
    assert not (tmp_path / "out").exists()
    before = path.read_bytes()
    assert jbrep(*command).exit_code == 0  # the same once more
    assert path.read_bytes() == before
    (tmp_path / "it.toml").write_text(study.replace(steps=90).toml())
    assert jbrep(*command).exit_code == 0
    assert registration_in(path).registered.steps == 90


def test_only_encoders_that_are_there_beforehand_are_registered(tmp_path):
    path = tmp_path / "mine.safetensors"
    save(find("pca-8", "face_direction"), path)
    mine = {"name": "mine", "file": str(path)}
    plan = Plan(TINIER.replace(representations=("pca-4", mine)), tmp_path / "shipped")
    register_study(plan)
    shas = {"pca-4": find("pca-4", "face_direction"), "mine": load(path)}
    assert plan.registration.encoders == {
        cell.name: shas[cell.representation.name].fingerprint for cell in plan.cells
    }
    data = {"": Data(steps=1000)}
    plan = Plan(TINIER.replace(representations=("full", mine), data=data), tmp_path / "made")
    register_study(plan)
    assert {name.split("/")[2] for name in plan.registration.encoders} == {"mine"}
    assert not (plan.folder / "data").exists()


def test_other_policies_and_data_than_were_registered_are_told(collected, tmp_path):
    data = {"": Data(steps=100, policy="uniform:0.5+trained:0.5")}
    study = TINIER.replace(data=data)
    plan = Plan(study, tmp_path / "study")
    with of_a_commit():
        register_study(plan)
    prepare(plan)
    (name,) = plan.registration.policies
    assert plan.policies == plan.registration.policies
    assert plan.deviations([]) == []
    plan.registration = plan.registration.replace(policies={name: "0" * 64})
    assert plan.deviations([]) == [f"policies are others than were registered: {name}"]
    there = Plan(TINIER.replace(data={"": Data(folder=str(collected))}), tmp_path / "there")
    with of_a_commit():
        register_study(there)
    assert there.deviations([]) == []
    there.registration = there.registration.replace(data={str(collected): "0" * 64, "gone": "0"})
    other, missing = there.deviations([])
    assert (str(collected) in other, "gone" in missing) == (True, True)


def test_the_policy_that_scores_1_is_checked_and_registered(tmp_path):
    path = shutil.copy(shipped_file("face_direction"), tmp_path / "good.safetensors")
    plan = Plan(TINIER.replace(verdicts=Rules(reference=str(path))), tmp_path / "study")
    with of_a_commit():
        register_study(plan)
    path.write_bytes(shipped_file("move_to_pose").read_bytes())
    assert plan.deviations([]) == [f"policies are others than were registered: {path}"]
    for wrong in (str(path), "no-such-run"):
        with pytest.raises(InputError, match=r"verdicts\.reference can't play face_direction"):
            check(Plan(TINIER.replace(verdicts=Rules(reference=wrong)), tmp_path / "other"))


def test_claims_in_a_work_tree_run_once_they_are_committed(repository, tmp_path, monkeypatch):
    monkeypatch.setattr("jbrep.reporting.report.write_report", lambda found, out: [out])
    path, out = repository / "it.toml", tmp_path / "out"
    beside = repository / "it.registration.json"
    path.write_text(CLAIMS.toml())
    commit(repository)

    def refused():
        told = jbrep("study", path, "--out", out, "--workers", 1)
        assert (told.exit_code, out.exists()) == (2, False)
        assert str(beside) in told.stderr
        assert "--register" in told.stderr

    refused()
    told = jbrep("study", path, "--register", "--out", out)
    assert told.exit_code == 0, told.output
    assert "Commit it.registration.json" in told.stderr
    refused()  # as it isn't in a commit
    commit(repository)
    whole = beside.read_text()
    beside.write_text(whole + " ")
    refused()
    beside.write_text(whole)
    path.write_text(CLAIMS.replace(steps=32).toml())
    refused()  # as it is of another study
    path.write_text(CLAIMS.toml())
    assert run_study(Plan(CLAIMS, out, path), first_run, 1) == 0
    assert (out / REGISTRATION).read_text() == whole
    registration = registration_in(out / REGISTRATION)
    assert registration.committed
    (run,) = runs_below(out)
    assert read_run(run).settings.registration == registration.sha256
    beside.unlink()
    assert jbrep("study", path, "--out", out, "--register").exit_code == 2  # there are runs
    registration.replace(date="2000-01-01T00:00:00+00:00").write(beside)
    commit(repository)
    with pytest.raises(InputError, match="with another registration"):
        run_study(Plan(CLAIMS, out, path), in_this_process, 1)


def test_without_claims_a_study_needs_no_registration_but_keeps_to_one(repository, tmp_path):
    path = repository / "it.toml"
    path.write_text(TINIER.toml())
    commit(repository)
    assert find_committed(path, TINIER) is None
    register_study(Plan(TINIER, tmp_path / "it", path))
    with pytest.raises(InputError, match=r"it\.registration\.json isn't as in the last commit"):
        run_study(Plan(TINIER, tmp_path / "it", path), in_this_process, 1)
    commit(repository)
    assert find_committed(path, TINIER).registered == TINIER
    begun = Plan(TINIER, tmp_path / "it", path)
    begun.folder_of(begun.cells[0]).mkdir(parents=True)
    (begun.folder_of(begun.cells[0]) / RUN).write_text("{}")
    with pytest.raises(InputError, match="has runs"):
        begun.register(find_committed(path, TINIER))


@pytest.mark.usefixtures("one_figure")
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
    assert registration.deviations(study, runs, {}, {}) == []
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
    assert registration.deviations(more, [*changed, *others], {}, {}) == [
        "settings differ: steps 80 (now: 81)",
        "seeds were added, whose runs are exploratory: 7",
        "1 of its runs weren't made under this registration",
        "1 of its runs have other encoders than were registered",
        f"torch was 2.0.0, not {registration.versions['torch']}",
        "some runs were made by other commits of jbrep's code",
    ]


def test_a_registration_comes_first_and_stays_as_it_is(tmp_path):
    plan = Plan(TINIER, tmp_path / "late")
    register_study(plan)
    path = plan.folder / REGISTRATION
    path.write_text(path.read_text().replace('"steps": 80', '"steps": 81'))
    with pytest.raises(InputError, match="was changed after it was written"):
        registration_in(path)
    path.unlink()
    plan.folder_of(plan.cells[0]).mkdir(parents=True)
    (plan.folder_of(plan.cells[0]) / RUN).write_text("{}")
    with pytest.raises(InputError, match="has runs: a study is registered before its first run"):
        register_study(Plan(TINIER, plan.folder))


@pytest.mark.parametrize(
    "path", sorted((ROOT / "results").glob(f"*/{REGISTRATION}")), ids=lambda p: p.parent.name
)
def test_the_committed_results_are_of_the_studies_that_were_registered(path):
    """Of releases up to 0.3 the registration is a witness that nothing reads: its seal holds."""
    given = json.loads(path.read_text())
    head = ("format", "format_version", "sha256")
    assert given["sha256"] == seal({n: v for n, v in given.items() if n not in head})
    record = read_document(path.with_name(RECORD), RunsRecord)
    assert record.registration.sha256 == given["sha256"]
    name = f"{path.parent.name}.toml"
    if (ROOT / "examples/robots" / name).exists():  # of robots that aren't known here
        return
    study = read_study(ROOT / "studies" / name)
    assert record.study.replace(title="", evaluations=()) == study.replace(title="", evaluations=())


def test_a_study_with_claims_is_registered_when_it_begins(tmp_path, monkeypatch):
    """Without a registration before the first run, there are no verdicts."""
    stopped = Mock(side_effect=[KeyboardInterrupt, None])
    monkeypatch.setattr(runner, "prepare", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_study(Plan(CLAIMS, tmp_path / "study"), first_run, 1)
    monkeypatch.setattr(Plan, "to_register", Mock(side_effect=AssertionError))
    assert run_study(Plan(CLAIMS, tmp_path / "study"), first_run, 1) == 0
    again = Plan(CLAIMS, tmp_path / "study")
    assert "its registration is in no commit" in again.deviations([])
    judging = again.registration.registered.planned
    assert (judging.rules.claims, judging.seeds) == (CLAIMS.verdicts.claims, CLAIMS.seeds)
    (run,) = runs_below(again.folder)
    assert read_run(run).settings.registration == again.registration.sha256
    (again.folder / REGISTRATION).unlink()
    with pytest.raises(DamageError, match=f"{REGISTRATION} is missing"):
        write_tables(again.folder)


HEAD = "0123456789" * 4


def test_a_commit_and_whether_files_differ_from_it(tmp_path, monkeypatch):
    folder = tmp_path / "work" / "deeper"
    folder.mkdir(parents=True)
    assert of_git._commit(folder) == ""
    git(tmp_path, "init", "-q")
    assert of_git._commit(folder) == ""  # nothing is committed
    (folder / "file").write_text("one")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "one")
    head = git(tmp_path, "rev-parse", "HEAD")
    (folder / "untracked").write_text("two")
    assert of_git._commit(folder) == head
    (folder / "file").write_text("two")
    assert of_git._commit(folder) == f"{head}+changes"
    installed = folder / "site-packages"
    installed.mkdir()
    assert of_git._commit(installed) == ""
    monkeypatch.setenv("PATH", str(tmp_path))
    assert of_git._commit(folder) == ""  # without git


def test_a_manifest_says_the_commit_of_its_start_and_resumes_at_another(collected, tmp_path):
    assert read_manifest(collected).commits == dict(of_git.commits())
    folder = tmp_path / "data"
    manifest = write_again(collected, folder).replace(commits={"jbrep": HEAD})
    manifest.replace(shards=manifest.shards[:4]).write(folder / MANIFEST)
    collect(settings(), folder)
    assert read_manifest(folder) == manifest
    assert Dataset(folder).fingerprint == Dataset(collected).fingerprint
    shards = [name for name in contents(folder) if name.endswith(".h5")]
    assert all(contents(folder)[name] == contents(collected)[name] for name in shards)
    with pytest.raises(InputError, match="commits"):
        manifest.replace(commits={"jbrep": "main"})


def test_an_encoder_is_the_same_at_another_commit(tmp_path):
    encoder = find("dae-8", describe("face_direction"))
    other = encoder.with_header(commits={"work": HEAD})
    save(other, tmp_path / "it.safetensors")
    assert load(tmp_path / "it.safetensors").header.commits == {"work": HEAD}
    assert load(tmp_path / "it.safetensors").fingerprint == encoder.fingerprint
