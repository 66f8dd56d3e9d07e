"""Killed, without space or damaged: whole, or refused in a line. At small size."""

import subprocess
import sys

import pytest

NAMES = ("checkpoints of sac", "import of parquet", "registration")  # tools/attack.py has all


@pytest.mark.slow
def test_whatever_happens_to_a_command_nothing_false_comes_of_it():
    """In a process of its own, as it forks."""
    command = [sys.executable, "-W", "ignore", "tools/attack.py", "1", *NAMES]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("\n0 faults\n")
    assert all(f"{name}: " in done.stdout for name in NAMES)
