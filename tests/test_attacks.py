"""Killed, without space, at once with another or damaged: whole, or refused in a line.

At small size; tools/attack.py does the same at full size.
"""

import pytest
from attacks import attack
from surfaces import surfaces

NAMES = (
    *("tune", "checkpoints of sac", "import of parquet", "import of minari"),
    *("encoder import", "registration", "report"),
)


@pytest.fixture(scope="module")
def attacked(tmp_path_factory):
    return {each.name: each for each in surfaces(tmp_path_factory.mktemp("attacked"))}


@pytest.mark.parametrize("name", NAMES)
def test_whatever_happens_to_a_command_nothing_false_comes_of_it(name, attacked, tmp_path):
    tally = attack(attacked[name], tmp_path, kills=1, full=1, flips=6)
    assert not tally.faults
