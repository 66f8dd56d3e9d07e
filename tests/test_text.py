"""Tables that fit a terminal; names as words."""

from jbrep.text import slug, table, words

HEADER = ("encoder", "error", "ratio", "worst feature")
ROWS = [("dae-8", "0.01", "1.10", "velocity_x"), ("dae-12", "0.002", "1.05", "motor_angle")]


def test_any_names_become_different_words():
    given = ["t", "θ", "ώ", "é", "q[0]", "q[1]", "_x", "0", "a b", "a_b", "", "step", "action_1"]
    assert words(given) == [
        *("t", "theta", "omega", "e", "q_0", "q_1", "x", "obs_0", "a_b", "a_b_2"),
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
