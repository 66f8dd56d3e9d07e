"""How long it takes to record an episode of 1,000 steps, and how large the recording is.

python benchmarks/inspection.py; imports and the first use of a library aside. Seconds are of the
fastest round, as others share the machine.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from timing import timed

from jbrep.encoders import find
from jbrep.inspection.subject import record_episode, record_traversal
from jbrep.play.sources import find_episode

ROUNDS = 5
TASK = "move_to_pose"  # which observes most


def fastest(work: Callable[[], object]) -> float:
    """Seconds; a first round doesn't count."""
    work()
    return min(timed(work) for _ in range(ROUNDS))


def show(what: str, seconds: float, size: float = 0, aim: str = "") -> None:
    megabytes = f"{size / 1e6:6.2f} MB" if size else " " * 9
    print(f"{what:32} {seconds:6.2f} s {megabytes}   {aim}", flush=True)


def main(out: Path) -> None:
    replay = partial(find_episode, f"data/sample/{TASK}")
    episode = replay()
    replaying = fastest(replay)
    show("replaying", replaying)
    show("recording", fastest(partial(record_episode, episode, out)), out.stat().st_size)
    for name in ("dae-8", "full"):
        encoder = find(name, episode.task)
        seconds = fastest(partial(record_episode, episode, out, encoder))
        show(f"recording with {name}", seconds, out.stat().st_size)
        aim = "aim below 1 s and 3 MB"
        show(f"replaying and that, {name}", replaying + seconds, out.stat().st_size, aim)
        seconds = fastest(partial(record_traversal, episode, out, encoder))
        show(f"the units of {name}", seconds, out.stat().st_size)


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        main(Path(folder) / "episode.rrd")
