"""What an environment is made from: the files that its arguments name, the modules of its class."""

import ast
import hashlib
import inspect
import os
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from contextlib import suppress
from importlib.util import resolve_name
from pathlib import Path
from types import ModuleType
from typing import Any

from gymnasium.envs.registration import EnvSpec

from jbrep.envs.make import creator
from jbrep.envs.names import spec_of
from jbrep.envs.task import Task, changed_parts

_MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")  # of files that name others
_NAMED = re.compile(r"""\b(?:file(?:name)?|\w*dir)\s*=\s*["']([^"']+)["']""")
_MOST_FILES = 1000  # of a folder, whose contents are hashed
_LIBRARIES = ("stdlib", "platstdlib", "purelib", "platlib")
_INSTALLED = (  # code that packages' versions stand for
    *(Path(sysconfig.get_path(name)).resolve() for name in _LIBRARIES),
    Path(__file__).resolve().parents[1],
)


def absolute(argument: Any) -> Any:
    """An argument in which the files that it names are absolute paths.

    A file is text with a separator or a suffix, where there is one; a folder needs a separator.
    """
    if isinstance(argument, str):
        path = _path(argument)
        return str(path) if path else argument
    if isinstance(argument, Mapping):
        return {name: absolute(value) for name, value in argument.items()}
    if isinstance(argument, list | tuple):
        return [absolute(each) for each in argument]
    return argument


def files_of(arguments: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of what arguments name, by the arguments' names; a model's with the files it names.

    Args:
        arguments: of an environment.
    """
    hashes: dict[str, str] = {}
    for name, value in arguments.items():
        if paths := list(_paths(value)):
            contents = [each for path in paths for each in _contents(path)]
            hashes[name] = hashlib.sha256("".join(contents).encode()).hexdigest()
    return hashes


def code_of(spec: EnvSpec) -> dict[str, str]:
    """`code_behind` of what makes an environment."""
    return code_behind(creator(spec))


def code_behind(maker: Any) -> dict[str, str]:
    """SHA-256 of the modules that define a class or function, and of the user's that they import.

    Installed packages are left out, which have versions. Of a script or notebook that is run it is
    the source of the class or function alone.
    """
    maker = getattr(maker, "func", maker)  # of a partial function
    classes = [each for each in getattr(maker, "__mro__", (maker,)) if hasattr(each, "__module__")]
    hashes = {
        f"class {each.__name__}": hashlib.sha256(source.encode()).hexdigest()
        for each in classes
        if each.__module__ == "__main__" and (source := _source(each))
    }
    names, seen = [each.__module__ for each in classes], {"__main__"}
    while names:
        name = names.pop()
        module = sys.modules.get(name)
        if name in seen or module is None or not (path := _own_file(module)):
            continue
        seen.add(name)
        hashes[f"module {name}"] = _digest(path)
        names += _imports(path, module)
    return dict(sorted(hashes.items()))


def changes_of(task: Task) -> str:
    """What is not what it was when a task was described, for a message; empty if all is."""
    if not task.made_from:
        return ""
    spec = spec_of(task)
    files = files_of({**spec.kwargs, **task.arguments})
    now = {**files, **code_of(spec)}
    known = {name: now.get(name, "0" * 64) for name in task.made_from}
    return changed_parts(task, task.replace(made_from=known))


def _source(maker: Any) -> str:
    with suppress(OSError, TypeError):
        return inspect.getsource(maker)
    return ""


def _path(text: str) -> Path | None:
    """The file or folder that text names, absolute; None if it names none."""
    has_separator = "/" in text or os.sep in text
    with suppress(OSError, ValueError, RuntimeError):
        path = Path(os.path.abspath(Path(text).expanduser()))  # noqa: PTH100 - without ".."
        if (path.is_file() and (has_separator or path.suffix)) or (has_separator and path.is_dir()):
            return path
    return None


def _paths(argument: Any) -> Iterator[Path]:
    if isinstance(argument, str | os.PathLike):
        if path := _path(os.fspath(argument)):
            yield path
    elif isinstance(argument, Mapping | list | tuple):
        inner = argument.values() if isinstance(argument, Mapping) else argument
        for each in inner:
            yield from _paths(each)


def _contents(path: Path) -> list[str]:
    """SHA-256 of each file of a path; of a folder of very many their names and sizes."""
    files = _with_named(path)
    if len(files) <= _MOST_FILES or not path.is_dir():
        return [_digest(each) for each in files]
    return [f"{each.relative_to(path)} {each.stat().st_size}" for each in files]


def _with_named(path: Path) -> list[Path]:
    """A file with those that it names in turn, if it is a robot's model; the files of a folder."""
    if path.is_dir():
        return sorted(each for each in path.rglob("*") if each.is_file())
    found = [path]
    for model in found:  # which grows
        if model.suffix.lower() not in _MODEL_SUFFIXES:
            continue
        with suppress(OSError):
            named = _NAMED.findall(model.read_text(errors="replace"))
            folders = {model.parent, path.parent}
            folders |= {folder / name for folder in folders for name in named}
            files = sorted(folder / name for folder in folders for name in named)
            found += [each for each in files if each.is_file() and each not in found]
    return found


def _digest(path: Path) -> str:
    """SHA-256 of a file; empty where it can't be read."""
    with suppress(OSError), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
    return ""


def _own_file(module: ModuleType) -> Path | None:
    """A module's file, unless a package's version stands for it."""
    file = getattr(module, "__file__", None)
    path = Path(file).resolve() if file else None
    if path is None or any(folder in path.parents for folder in _INSTALLED):
        return None
    return path if path.is_file() else None


def _imports(path: Path, module: ModuleType) -> Iterator[str]:
    """The names of modules that one imports when it is imported, and of what it takes of them."""
    with suppress(OSError, SyntaxError, ValueError, ImportError):
        for node in _run_at_import(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                relative = "." * node.level + (node.module or "")
                base = resolve_name(relative, module.__package__ or "")
                yield base
                yield from (f"{base}.{alias.name}" for alias in node.names)


def _run_at_import(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield child
            yield from _run_at_import(child)
