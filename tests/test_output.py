"""What commands print: tables that fit, names as words, and output that nobody reads."""

import subprocess
import sys

from jbrep.text import slug, table, words

SAMPLE = "data/sample/face_direction"
JBREP = f"{sys.executable} -c 'from jbrep.cli import main; main()'"
COLLECT = "collect --task face_direction --steps 1k --out"


def shell(line):
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line.replace("jbrep", JBREP, 1)],
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout, done.stderr


def test_a_reader_that_has_seen_enough_is_no_error(tmp_path):
    assert shell(f"jbrep data info {SAMPLE} | head -1") == (0, f"{SAMPLE}\n", "")
    assert shell(f"jbrep {COLLECT} {tmp_path / 'data'} | true")[0] == 0
    assert shell(f"jbrep data verify {tmp_path / 'data'}")[0] == 0


def test_output_that_finds_no_space_is_a_line():
    code, _, err = shell(f"jbrep data info {SAMPLE} >/dev/full")
    assert (code, err.count("\n")) == (2, 1)
    assert "No space left on device" in err


HEADER = ("encoder", "error", "ratio", "worst feature")
ROWS = [("dae-8", "0.01", "1.10", "velocity_x"), ("dae-12", "0.002", "1.05", "motor_angle")]


def test_any_names_become_different_words():
    given = ["t", "θ", "ώ", "é", "q[0]", "q[1]", "_x", "0", "a b", "a_b", "", "step", "action_1"]
    assert words(given) == [
        *("t", "theta", "omega", "e", "q_0", "q_1", "x", "obs_0", "a_b_2", "a_b"),
        *("obs", "obs_step", "obs_action_1"),
    ]


def test_a_table_that_is_too_wide_is_cut_into_parts_that_fit_with_every_cell_once():
    shown = table(HEADER, ROWS, width=24)
    assert max(map(len, shown.splitlines())) <= 24
    parts = [part.splitlines() for part in shown.split("\n\n")]
    assert [part[1].split()[0] for part in parts] == ["dae-8"] * len(parts)
    assert len(parts) > 1
    for cell in (cell for row in (HEADER, *ROWS) for cell in row[1:]):
        assert shown.count(cell) == 1


def test_a_slug_has_hyphens_for_what_a_path_should_not_hold():
    assert slug("dm_control/cheetah-run-v0") == "dm_control-cheetah-run-v0"
    assert slug("my_package:Env-v0 \u00e9\n..") == "my_package-Env-v0---.."
    assert slug("face_direction") == "face_direction"
