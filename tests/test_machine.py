"""What a process may use of its machine."""

import pytest

from jbrep import machine


@pytest.mark.parametrize("limit", machine._LIMITS)
def test_a_container_has_less_memory_than_its_machine(limit, tmp_path, monkeypatch):
    (tmp_path / "memory").mkdir()
    (tmp_path / limit).write_text(f"{256 << 20}\n")
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    assert machine.memory() == 256 << 20
