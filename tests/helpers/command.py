"""jbrep's commands, as a stranger would type them."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from jbrep.cli import main
from jbrep.errors import InputError
from jbrep.studies.runner import work


def jbrep(*arguments):
    """A command in this process; a mistake has its one line, anything else is a bug."""
    result = CliRunner().invoke(main, [str(a) for a in arguments], prog_name="jbrep")
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def mistake(*arguments):
    """The one line that a command ends with where it is used wrongly."""
    told = jbrep(*arguments)
    assert (told.exit_code, told.output.count("\n")) == (2, 1)
    return told.output


def refused(use, *arguments, **named):
    """The one line that a user of Python gets."""
    with pytest.raises(InputError) as error:
        use(*arguments, **named)
    assert "\n" not in str(error.value)
    return str(error.value)


def start(*arguments):
    """The same in a process of its own, which can be killed."""
    command = [sys.executable, "-c", "from jbrep.cli import main; main()", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def in_this_process(plan, cells, workers):
    """A backend that starts no process and sees what a test has patched."""
    for cell in cells:
        yield work(plan.assigned(cell))


def wait_for(happened, process, seconds=120):
    """Wait until something has happened that a process does; whether it is still at work then."""
    deadline = time.monotonic() + seconds
    while not (found := happened()) and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return found and process.poll() is None


def workers_of(pid):
    """The workers of the study that a process runs."""
    found = subprocess.run(["pgrep", "-P", str(pid), "-f", "popen_loky"], capture_output=True)
    return [int(each) for each in found.stdout.split()]


def wait_for_the_end_of(processes, seconds=60):
    """Wait until none of them is left, as when their parent is gone."""
    deadline = time.monotonic() + seconds
    while any(map(_is_alive, processes)):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _is_alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"
