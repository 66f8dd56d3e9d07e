"""What import-linter doesn't see: imports by a string, and circles."""

import ast
import re
import tomllib
from graphlib import TopologicalSorter
from pathlib import Path

import grimp

CONTRACTS = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
LAYERS = [re.split(r" \| ", layer) for layer in reversed(CONTRACTS[0]["layers"])]
RANKS = {room: rank for rank, rooms in enumerate(LAYERS) for room in rooms}


ROOMS = rf"({'|'.join(map(re.escape, RANKS))})([.:]\w+)*\Z"  # and what is below them


def rank_of(module):
    """Which layer a module is in, from the bottom; the package itself is above all."""
    return RANKS.get(".".join(module.split(".")[:2]), len(LAYERS))


def test_no_string_names_a_module_above():
    named = 0
    for path in Path("jbrep").rglob("*.py"):
        room = rank_of(".".join(path.with_suffix("").parts))
        for node in ast.walk(ast.parse(path.read_text())):
            text = node.value if isinstance(node, ast.Constant) else None
            if isinstance(text, str) and re.match(ROOMS, text):
                named += 1
                assert rank_of(text.partition(":")[0]) <= room, f"{path}:{node.lineno}"
    assert named > 10


def test_no_imports_go_in_a_circle():
    graph = grimp.build_graph("jbrep", exclude_type_checking_imports=True, cache_dir=None)
    imports = {each: graph.find_modules_directly_imported_by(each) for each in graph.modules}
    TopologicalSorter(imports).prepare()
