"""Commands whose output is closed, full, or no longer read."""

import subprocess
import sys

import pytest

SAMPLE = "data/sample/face_direction"
JBREP = f"{sys.executable} -c 'from jbrep.cli import main; main()'"
COLLECT = "collect --task face_direction --steps 1k --out"


def shell(line):
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line.replace("jbrep", JBREP, 1)],
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout, done.stderr


def test_a_reader_that_has_seen_enough_is_no_error():
    assert shell(f"jbrep data info {SAMPLE} | head -1") == (0, f"{SAMPLE}\n", "")
    assert shell(f"jbrep data info {SAMPLE} | true") == (0, "", "")


@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&- >&- 2>&-"])
def test_closed_streams_change_no_result(closed, tmp_path):
    assert shell(f"jbrep {COLLECT} {tmp_path / 'data'} {closed}")[0] == 0
    code, out, _ = shell(f"jbrep data verify {tmp_path / 'data'} 2>&-")
    assert (code, "1,000 rows, 1 shard" in out) == (0, True)
    assert shell(f"jbrep data info {tmp_path / 'none'} {closed}")[0] == 2


def test_output_that_is_lost_is_told_once_the_work_is_done(tmp_path):
    code, _, err = shell(f"jbrep {COLLECT} {tmp_path / 'data'} >/dev/full")
    assert (code, err) == (1, "Error: can't write the output: No space left on device\n")
    assert shell(f"jbrep data verify {tmp_path / 'data'}")[0] == 0


def test_messages_that_are_lost_change_no_result(tmp_path):
    assert shell(f"jbrep {COLLECT} {tmp_path / 'data'} 2>/dev/full")[0] == 0
    assert shell(f"jbrep data info {tmp_path / 'none'} 2>/dev/full")[0] == 2
