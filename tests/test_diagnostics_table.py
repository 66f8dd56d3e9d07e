"""The table of what diagnostics say of encoders."""

import pytest

from jbrep.encoders.diagnostics import Diagnosed, by_label, read_diagnostics, write_diagnostics
from jbrep.errors import DamageError, InputError

ROWS = [
    Diagnosed("face_direction", "dae-8", "a" * 64, {"forward": 0.25, "value": None}),
    Diagnosed("face_direction", "dae-8", "b" * 64, {"forward": 0.75, "value": -1e-9}),
    Diagnosed("dm_control/cheetah-run-v0", "mine, or not", "c" * 64, {"forward": None}),
]


def test_the_table_comes_back_as_it_was(tmp_path):
    write_diagnostics(tmp_path / "t.csv", ROWS)
    *first, last = read_diagnostics(tmp_path / "t.csv")
    assert first == ROWS[:2]
    assert last == ROWS[2]._replace(values={"forward": None, "value": None})


def test_encoders_of_one_representation_are_averaged():
    assert by_label(ROWS) == {
        ("face_direction", "dae-8"): {"forward": 0.5, "value": -1e-9},
        ("dm_control/cheetah-run-v0", "mine, or not"): {"forward": None},
    }


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a,b\n",
        "task,representation,sha256,x\nt,r,s\n",
        "task,representation,sha256,x\nt,r,s,nan\n",
        "task,representation,sha256,x\nt,r,s,many\n",
        "task,representation,sha256,x,x\nt,r,s,1,2\n",
    ],
)
def test_another_file_is_refused(text, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DamageError, match=r"t\.csv is damaged, or not a table of diagnostics"):
        read_diagnostics(tmp_path / "t.csv")
    with pytest.raises(InputError, match="can't read"):
        read_diagnostics(tmp_path / "none.csv")
