"""Killed, without space, at once with another or damaged: whole, or refused in a line.

At small size; tools/attack.py does the same at full size.
"""

import pytest
from attacks import attack
from surfaces import surfaces


@pytest.fixture(scope="module")
def attacked(tmp_path_factory):
    return surfaces(tmp_path_factory.mktemp("attacked"))


def test_whatever_happens_to_a_command_nothing_false_comes_of_it(attacked, tmp_path):
    for surface in attacked:
        tally = attack(surface, tmp_path, kills=2, full=2, twice=1, flips=12)
        assert not tally.faults, (surface.name, tally.faults)
