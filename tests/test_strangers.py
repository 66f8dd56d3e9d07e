"""A stranger's folder: nothing outside it is read or written, whatever links are in it."""

import pytest
from command import in_this_process, refused
from test_study import TINY

from jbrep.envs import describe
from jbrep.envs.names import spec_of
from jbrep.errors import InputError
from jbrep.records.lock import exclusive
from jbrep.records.storage import inside, read_regular, write_new, write_note, write_whole
from jbrep.report import make_report
from jbrep.report.report import FIGURES, FINDINGS, MARKDOWN, PAGE
from jbrep.rl.files import ENCODER, EPISODES, EVALUATIONS, POLICY, POLICY_ZIP
from jbrep.study.plan import Plan
from jbrep.study.record import RECORD
from jbrep.study.runner import run_study
from jbrep.study.tables import RETURNS
from jbrep.study.work import ERROR, PROGRESS

TINIEST = TINY.replace(representations=("full",), seeds=(0,))
OF_A_RUN = (PROGRESS, ERROR, ENCODER, EPISODES, EVALUATIONS, POLICY, POLICY_ZIP)
OF_A_STUDY = (RECORD, RETURNS, PAGE, FINDINGS, MARKDOWN)


@pytest.fixture
def precious(tmp_path):
    """A file and a folder of the user's."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("precious")
    yield tmp_path / "mine"
    assert [each.name for each in (tmp_path / "mine").iterdir()] == ["file"]
    assert (tmp_path / "mine" / "file").read_text() == "precious"


def test_no_file_is_written_or_read_through_a_link(precious, tmp_path):
    for write in (
        lambda path: write_note(path, "x"),
        lambda path: write_whole(path, b"x"),
        lambda path: write_whole(path.with_name("other"), b"x"),
        lambda path: refused(write_new, path, b"x"),
    ):
        for name in ("it", "it.partial", "other.partial", ".it.lock"):
            (tmp_path / name).unlink(missing_ok=True)
            (tmp_path / name).symlink_to(precious / "file")
        (tmp_path / ".it.lock").unlink()
        write(tmp_path / "it")
    (tmp_path / "link").symlink_to(precious / "file")
    assert read_regular(tmp_path / "link", 100) == b""
    (tmp_path / ".lock").symlink_to(precious / "file")
    with pytest.raises(InputError, match="can't write in"), exclusive(tmp_path):
        pass


def test_the_module_to_import_for_a_strangers_task_is_one_word():
    trap = {"module x; touch trap #": "0" * 64}
    task = describe("face_direction").replace(id="Away/Robot-v0", made_from=trap)
    assert "; add --import 'x; touch trap #': " in refused(spec_of, task)


def test_what_is_inside_a_folder_is_reached_without_links(tmp_path):
    (tmp_path / "real" / "a").mkdir(parents=True)
    (tmp_path / "own").symlink_to("real")  # the user's: where the folder is kept
    assert inside(tmp_path / "own", "a", "b/c") == tmp_path / "own" / "a" / "b" / "c"
    (tmp_path / "real" / "a" / "b").symlink_to(tmp_path)
    assert "a/b is a link" in refused(inside, tmp_path / "own", "a", "b/c")
    for outside in ("../precious", "a/../../b", "/etc/passwd"):
        assert f"{outside} leads out of " in refused(inside, tmp_path / "own", outside)


def test_a_study_with_links_for_files_replaces_the_links(precious, tmp_path):
    plan = Plan(TINIEST, tmp_path / "study")
    folder = plan.folder_of(plan.cells[0])
    folder.mkdir(parents=True)
    for path in [folder / name for name in OF_A_RUN] + [plan.folder / name for name in OF_A_STUDY]:
        for each in (path, path.with_name(f"{path.name}.partial")):
            each.symlink_to(precious / "file")
    assert run_study(plan, in_this_process, 1) == 0
    make_report(plan.folder)
    assert (plan.folder / PAGE).is_file()
    assert not any((folder / name).is_symlink() for name in OF_A_RUN)


@pytest.mark.parametrize("name", ["runs", "runs/face_direction", "data", "tensorboard"])
def test_a_study_with_links_for_folders_is_refused(name, precious, tmp_path):
    data = {"steps": 500} if name == "data" else None
    plan = Plan(TINIEST.replace(data=data), tmp_path / "study")
    run = tmp_path / "study" / "runs" / plan.cells[0].name
    link = run / name if name == "tensorboard" else plan.folder / name
    link.parent.mkdir(parents=True)
    link.symlink_to(precious)
    if name == "tensorboard":
        assert run_study(plan, in_this_process, 1) == 1
        assert "tensorboard is a link" in (run / ERROR).read_text()
    else:
        assert f"{name} is a link" in refused(run_study, plan, in_this_process, 1)


def test_a_report_with_a_link_for_its_figures_is_refused(precious, tmp_path):
    plan = Plan(TINIEST, tmp_path / "study")
    assert run_study(plan, in_this_process, 1) == 0
    (plan.folder / FIGURES).symlink_to(precious)
    assert "figures is a link" in refused(make_report, plan.folder)
