"""The table of what diagnostics say of encoders."""

import pytest

from jbrep.errors import DamageError, InputError
from jbrep.evaluate.table import (
    SCALARS,
    Diagnosed,
    by_label,
    diagnostics_text,
    read_diagnostics,
)

ROWS = [
    Diagnosed("face_direction", "dae-8", "a" * 64, {"forward": 0.25, "value": None}),
    Diagnosed("face_direction", "dae-8", "b" * 64, {"forward": 0.75, "value": -1e-9}),
    Diagnosed("dm_control/cheetah-run-v0", "mine, or not", "c" * 64, {"forward": None}),
]
KEY = "task,representation,sha256"
NAMES = ",".join(SCALARS)
EMPTY = "," * (len(SCALARS) - 1)


def test_the_table_comes_back_as_it_was(tmp_path):
    (tmp_path / "t.csv").write_text(diagnostics_text(ROWS))
    unknown = dict.fromkeys(SCALARS)
    whole = [row._replace(values=unknown | row.values) for row in ROWS]
    assert read_diagnostics(tmp_path / "t.csv") == whole


def test_encoders_of_one_representation_are_averaged():
    assert by_label(ROWS) == {
        ("face_direction", "dae-8"): {"forward": 0.5, "value": -1e-9},
        ("dm_control/cheetah-run-v0", "mine, or not"): {"forward": None},
    }


@pytest.mark.parametrize(
    "text",
    [
        "",
        f"{KEY},x\nt,r,s,1\n",
        f"{KEY},{NAMES}\nt,r,s\n",
        f"{KEY},{NAMES}\nt,r,s,nan{EMPTY}\n",
        f"{KEY},{NAMES}\nt,r,s,many{EMPTY}\n",
    ],
)
def test_another_file_is_refused(text, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DamageError, match=r"t\.csv is damaged"):
        read_diagnostics(tmp_path / "t.csv")
    with pytest.raises(InputError, match="can't read"):
        read_diagnostics(tmp_path / "none.csv")
