"""The data that a study's encoders are made from: several, by policies, made by several workers."""

import pickle
import tomllib

import pytest
from test_study import TINY

from jbrep.dataset import Dataset
from jbrep.encoders import load
from jbrep.errors import InputError
from jbrep.evaluation.evaluation import EVALUATION, Evaluation
from jbrep.records.document import read_document
from jbrep.records.record import to_plain
from jbrep.studies.config import Data, as_study
from jbrep.studies.plan import Plan
from jbrep.studies.prepare import check, prepare

TASK = "face_direction"
MIXTURE = "uniform:0.4+heuristic:0.3+trained:0.3"
DATA = {"apart": Data(steps=100), "mixed": Data(steps=100, policy=MIXTURE, seed=40)}
CODES = (
    "full",
    {"name": "pca-4", "data": "apart"},
    {"name": "late", "kind": "pca", "latent": 4, "data": "mixed", "encoders": 2},
)
STUDY = TINY.replace(tasks=(TASK, "move_in_direction"), representations=CODES, data=DATA)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A study with two tables of data, prepared by one worker."""
    plan = Plan(STUDY, tmp_path_factory.mktemp("data") / "one")
    plan.write()
    prepare(plan)
    return plan


def test_representations_are_made_from_their_own_data(made):
    for task in STUDY.tasks:
        headers = {
            path.stem: load(path).header for path in made.encoders(task).glob("*.safetensors")
        }
        assert headers.keys() == {"full", "pca-4", "late-s0", "late-s1"}
        seen = {name: header.data["fingerprint"] for name, header in headers.items()}
        assert seen["full"] == seen["pca-4"]  # the first
        assert len({*seen.values()}) == 3
        seeds = {name: header.data["seed"] for name, header in headers.items()}
        assert seeds == {"full": 0, "pca-4": 0, "late-s0": 40, "late-s1": 41}
        assert headers["pca-4"].data["policy"]["kind"] == "uniform"
        assert headers["late-s1"].data["policy"]["kind"] == "mixture"
        for name, number, table in (("pca-4", 0, "apart"), ("late-s1", 1, "mixed")):
            assert Dataset(made.data(task, number, table)).fingerprint == seen[name]


def test_encoders_are_evaluated_on_their_data_before_any_run(tmp_path, capfd):
    study = TINY.replace(data={"steps": 100}, representations=("full", "pca-4"), evaluate=True)
    plan = Plan(study, tmp_path / "it")
    plan.write()
    prepare(plan)
    (file,) = plan.folder.rglob(EVALUATION)
    assert file.parent == plan.folder / "evaluations" / TASK / "set-0"
    assert {*read_document(file, Evaluation).encoders} == {"full", "pca-4"}
    capfd.readouterr()
    prepare(plan)
    assert capfd.readouterr().err == ""


@pytest.fixture
def in_turn(monkeypatch):
    """Workers that are no processes: test_study has some."""

    def make(function, next_job, workers):
        jobs = map(pickle.dumps, iter(next_job, None))
        return ((job, function(job)) for job in map(pickle.loads, jobs))

    monkeypatch.setattr("jbrep.studies.prepare.side_by_side", make)


@pytest.mark.usefixtures("in_turn")
def test_workers_say_what_they_make(tmp_path, capfd):
    plan = Plan(STUDY, tmp_path / "two")
    plan.write()
    prepare(plan, 2)
    lines = capfd.readouterr().err.splitlines()
    assert "data.mixed of face_direction, set 1: encoder late-s1" in lines
    assert sum(line.endswith("states") for line in lines) == 6
    prepare(plan, 2)  # nothing is left to make
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("in_turn")
def test_a_mistake_of_a_worker_is_a_line(tmp_path):
    plan = Plan(STUDY, tmp_path / "it")
    path = plan.data(TASK, 0, "apart")
    path.parent.mkdir(parents=True)
    path.write_text("")  # in the place of a folder
    with pytest.raises(InputError) as error:
        prepare(plan, 2)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("data", [DATA, {"": Data(steps=9)}, {"one": Data(steps=9, sets=3)}])
def test_data_are_written_as_they_are_given(data):
    name = [*data][-1]
    of_last = {"name": "dae-8", "data": name} if name else "dae-8"
    study = TINY.replace(representations=("full", of_last), data=data)
    given = tomllib.loads(study.toml())
    assert given["data"] == (
        {n: each.table for n, each in data.items()} if name else data[""].table
    )
    assert as_study(given) == as_study(to_plain(study)) == study
    assert {key for key in study.flat() if key.startswith("data")} == (
        {f"data.{n}" for n in data} if name else {"data"}
    )


def test_each_encoder_has_a_data_set_of_its_own_unless_it_is_said_otherwise():
    many = {"name": "dae-8", "encoders": 4}
    study = TINY.replace(
        representations=("full", many, {"name": "mine", "file": "{encoder}", "encoders": 8}),
        seeds=tuple(range(8)),
        data={"": Data(steps=9)},
    )
    assert study.sets("") == 4
    assert study.replace(data={"": Data(steps=9, sets=1)}).sets("") == 1
    assert study.replace(data={"": Data(folder="it")}).sets("") == 1


@pytest.mark.parametrize(
    ("representations", "data", "named"),
    [
        (["full", "dae-8"], {"a": {"steps": 9}, "b": {"steps": 9}}, "dae-8: .* one of a, b"),
        ([{"name": "dae-8", "data": "c"}], {"a": {"steps": 9}}, "dae-8: .*'?c'?: .* a"),
        ([{"name": "dae-8", "data": "c"}], {"steps": 9}, "dae-8: .* left out"),
        ([{"name": "dae-8", "data": "c"}], None, r"dae-8 .*\[data\] is missing"),
        ([{"name": "m", "file": "it", "data": "a"}], {"a": {"steps": 9}}, "m: unknown data"),
        ([{"name": "m", "code": "my:E", "data": "a"}], {"a": {"steps": 9}}, "m: unknown data"),
        (["full"], {"a": {"steps": 9}, "b": {"steps": 9}}, r"data\.b is used by no"),
        ([{"name": "m", "file": "it"}], {"steps": 9}, "data is used by no"),
        (["full"], {"a": {"steps": 9}, "steps": 9}, "data has steps beside the table a"),
        (["full"], {"a/b": {"steps": 9}}, "the name of data is 'a/b'"),
        (["full"], {"a": {"rows": 9}}, r"unknown data\.a\.rows"),
        (["full"], {"a": {"folder": "it", "policy": "still"}}, "data.a: policy is still"),
    ],
)
def test_mistaken_data_are_refused(representations, data, named):
    given = {**to_plain(TINY), "representations": representations, "data": data}
    with pytest.raises(InputError, match=named) as error:
        as_study(given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("task", "policy", "named"),
    [
        (TASK, "sideways", "data.policy for face_direction: unknown policy 'sideways'"),
        ("Pendulum-v1", "heuristic", "data.policy for Pendulum-v1: .* no scripted policy"),
        ("Pendulum-v1", "trained", "data.policy for Pendulum-v1: no trained policy"),
    ],
)
def test_policies_are_tried_before_anything_is_made(task, policy, named, tmp_path):
    study = TINY.replace(tasks=(task,), data={"": Data(steps=9, policy=policy)})
    with pytest.raises(InputError, match=named):
        check(Plan(study.replace(representations=("full",)), tmp_path / "it"))
    assert not (tmp_path / "it").exists()


def test_named_data_may_come_later_but_not_change(made):
    Plan(
        STUDY.replace(
            representations=(*CODES, {"name": "pca-2", "data": "more"}),
            data={**DATA, "more": Data(steps=9)},
        ),
        made.folder,
    ).check_folder()
    other = {**DATA, "mixed": Data(steps=101, policy=MIXTURE, seed=40)}
    with pytest.raises(InputError, match=r"another study: data\.mixed"):
        Plan(STUDY.replace(data=other), made.folder).check_folder()
