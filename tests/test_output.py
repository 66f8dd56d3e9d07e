"""Commands whose output is no longer read."""

import subprocess
import sys

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


def test_a_reader_that_has_seen_enough_is_no_error(tmp_path):
    assert shell(f"jbrep data info {SAMPLE} | head -1") == (0, f"{SAMPLE}\n", "")
    assert shell(f"jbrep {COLLECT} {tmp_path / 'data'} | true")[0] == 0
    assert shell(f"jbrep data verify {tmp_path / 'data'}")[0] == 0


def test_output_that_finds_no_space_is_a_line():
    code, _, err = shell(f"jbrep data info {SAMPLE} >/dev/full")
    assert (code, err.count("\n")) == (2, 1)
    assert "No space left on device" in err
