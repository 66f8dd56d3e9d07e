"""From states to a report, with every stage killed; test_golden has the chain undisturbed."""

import pytest
from pipeline import ends, in_peace, killed


@pytest.mark.slow
@pytest.mark.usefixtures("one_figure")
def test_killed_in_every_stage_it_comes_to_the_same_end(tmp_path):
    """`python tests/helpers/pipeline.py 20` kills at twenty times as many points."""
    in_peace(tmp_path / "peace")
    told = killed(tmp_path / "killed", 6)  # the study's workers are at work then
    found, expected = ends(tmp_path / "killed"), ends(tmp_path / "peace")
    assert found.keys() == expected.keys(), told
    for name, content in expected.items():
        assert found[name] == content, f"{name} differs; {told}"
