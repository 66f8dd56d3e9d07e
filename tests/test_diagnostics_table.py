"""Diagnostics are registered, and all that shows them follows; the table of many encoders."""

from pathlib import Path

import pytest
from wide import wide

from jbrep.errors import DamageError, InputError
from jbrep.evaluation import diagnose
from jbrep.evaluation.diagnosis import SCALARS
from jbrep.evaluation.evaluation import _REGISTERED, Scalar, Score, diagnostic
from jbrep.evaluation.table import Diagnosed, by_label, diagnostics_text, headline, read_diagnostics
from jbrep.reporting.evaluation import evaluation_text

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
