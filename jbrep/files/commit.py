"""Which git commit code or work is of, where there is one."""

import subprocess
from functools import cache
from pathlib import Path

_SECONDS = 5
_CHANGES = "+changes"


def commits() -> dict[str, str]:
    """The commits of jbrep and of the working directory, each where it is in a git repository.

    A commit is 40 hexadecimal digits, with "+changes" after them if files that git tracks differ
    from it. They are those of the first call.
    """
    known = {"jbrep": _commit(Path(__file__).parent), "work": _commit(Path.cwd())}
    return {name: commit for name, commit in known.items() if commit}


@cache
def _commit(folder: Path) -> str:
    """The commit of the repository that a folder is in; empty if there is none, or no git."""
    if folder_of := _git(folder, "rev-parse", "--show-toplevel"):
        own = "site-packages" in folder.relative_to(folder_of).parts
        commit = "" if own else _git(folder, "rev-parse", "HEAD")
        changes = _git(folder, "status", "--porcelain", "--untracked-files=no") if commit else ""
        return f"{commit}{_CHANGES if changes else ''}"
    return ""


def _git(folder: Path, *arguments: str) -> str:
    command = ("git", "--no-optional-locks", "-C", str(folder), *arguments)
    try:
        told = subprocess.run(command, capture_output=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return told.stdout.decode(errors="replace").strip() if told.returncode == 0 else ""
