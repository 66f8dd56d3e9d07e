"""Which git commits code and work are of, where there are any."""

import re
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from jbrep.records.record import pattern

_SECONDS = 5
CHANGES = "+changes"
Commits = Mapping[
    Annotated[str, pattern(r"\A(jbrep|work)\Z", "jbrep or work")],
    Annotated[
        str, pattern(rf"\A[0-9a-f]{{40,64}}({re.escape(CHANGES)})?\Z", "the hash of a commit")
    ],
]


@cache
def commits() -> Commits:
    """The last commits of jbrep's code and of the working directory, where git knows them.

    That of a folder is the last one that changed a file there. "+changes" stands after it if files
    that git tracks differ from it. They are those of the first call in a process.
    """
    places = {"jbrep": Path(__file__).resolve().parents[1]}
    with suppress(OSError):  # it may be deleted
        places["work"] = Path.cwd()
    known = {name: _commit(folder) for name, folder in places.items()}
    return MappingProxyType({name: commit for name, commit in known.items() if commit})


def in_work_tree(path: Path) -> bool:
    """Whether a file lies in a git repository's work tree."""
    return _git(path.absolute().parent, "rev-parse", "--is-inside-work-tree") == "true"


def is_committed(path: Path) -> bool:
    """Whether a file is as its repository's last commit has it."""
    folder = path.absolute().parent
    there = _git(folder, "rev-parse", "--verify", f"HEAD:./{path.name}")
    return bool(there) and there == _git(folder, "hash-object", "--", path.name)


def _commit(folder: Path) -> str:
    if "site-packages" in folder.parts:
        return ""  # installed in an environment that may lie in another project's repository
    commit = _git(folder, "log", "-1", "--format=%H", "--", ".")
    changes = commit and _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ".")
    return f"{commit}{CHANGES}" if changes else commit


def _git(folder: Path, *arguments: str) -> str:
    command = ("git", "--no-optional-locks", "-C", str(folder), *arguments)
    try:
        process = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return process.stdout.decode(errors="replace").strip() if process.returncode == 0 else ""
