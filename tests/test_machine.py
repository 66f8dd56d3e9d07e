"""What a process may use of its machine."""

import pytest

from jbrep import machine


@pytest.mark.parametrize("version", [1, 2])
def test_a_container_has_less_memory_than_its_machine(version, tmp_path, monkeypatch):
    """What only caches files can be had; 64 MiB of 256 are in use, 16 of them for files."""
    names = ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat")
    limit, used, stat = names if version == 1 else ("memory.max", "memory.current", "memory.stat")
    (tmp_path / "memory").mkdir()
    (tmp_path / limit).write_text(f"{256 << 20}\n")
    (tmp_path / used).write_text(f"{64 << 20}\n")
    (tmp_path / stat).write_text(f"anon 7\ninactive_file {16 << 20}\n")
    monkeypatch.setattr(machine, "_CGROUP", tmp_path)
    assert machine.memory() == 256 << 20
    assert machine.free_memory() == 208 << 20
