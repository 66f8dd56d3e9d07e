"""What messages say of errors and settings."""

import pytest

from jbrep.errors import differences, first_line, kind_and_line


@pytest.mark.parametrize(
    ("error", "line", "with_kind"),
    [
        (ValueError("\nno such joint\n  at line 3"), "no such joint", "ValueError: no such joint"),
        (KeyError("x"), "'x'", "KeyError: 'x'"),
        (RuntimeError(), "RuntimeError", "RuntimeError"),
    ],
)
def test_an_error_of_others_is_one_line(error, line, with_kind):
    assert first_line(error) == line
    assert kind_and_line(error) == with_kind


def test_at_most_three_settings_are_named_and_long_values_are_cut():
    there = dict.fromkeys("abcde", 1) | {"same": 2}
    wanted = {"same": 2, "a": "x" * 100, "b": 2, "c": 3, "d": 4, "e": 5}
    text = differences(there, wanted)
    assert text == f"a 1 (now: {'x' * 37}...), b 1 (now: 2), c 1 (now: 3), and 2 more"
    assert differences(there, there) == ""
    assert differences({}, {"a": 1}) == "a none (now: 1)"
    assert differences({"a": 1}, {}) == "a 1 (now: none)"


def test_what_differs_is_seen_within_tables():
    there = {"a": {"b": {"c": 1, "d": 2}, "e": 3}, "f": "x" * 50 + "yes"}
    wanted = {"a": {"b": {"c": 1, "d": 4}, "e": 3}, "f": "x" * 50 + "no"}
    assert differences(there, wanted) == "a.b.d 2 (now: 4), f"
