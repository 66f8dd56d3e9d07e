"""Ship the best agent for each task: python tools/policies.py FOLDER...

The folders have the runs of any studies. A task's best run has the highest mean return in the last
tenth of training; a task that none has learned gets no policy. Those episodes have other starts
than the evaluation's, so the returns that are written, which are of the evaluation's episodes,
aren't what it was chosen by.
"""

import csv
import sys
from itertools import chain
from pathlib import Path

import numpy as np

from jbrep.envs.description import describe
from jbrep.jitterbug.tasks import TASKS
from jbrep.play.sources import find_player
from jbrep.rl.files import EPISODES, FINISHED, read_run, runs_below
from jbrep.rl.policy import load_run
from jbrep.rl.policy_file import save
from jbrep.rl.shipped import SHIPPED, file_of, write_returns

SHOWN = (SHIPPED, "heuristic")
COUNTED = 100  # episodes
LAST = 0.1  # part of training


def score(run: Path, steps: int) -> float:
    """Mean return of the episodes that ended in the last part of training."""
    with (run / EPISODES).open() as file:
        episodes = [(int(row["step"]), float(row["return"])) for row in csv.DictReader(file)]
    return float(np.mean([value for step, value in episodes if step > (1 - LAST) * steps]))


def best(folders: list[Path]) -> dict[str, tuple[float, Path]]:
    """The best run of each task, with its score."""
    found: dict[str, tuple[float, Path]] = {}
    for path in chain.from_iterable(map(runs_below, folders)):
        run = read_run(path)
        task = run.settings.task
        if run.status == FINISHED and task in TASKS:
            scored = (score(path, run.settings.steps), path)
            found[task] = max(found.get(task, scored), scored)
    return {task: found[task] for task in TASKS if task in found}


def has_learned(run: Path, task: str) -> bool:
    """Whether a run's median return is nearer to the hand-written policy than to standing still."""
    still, learned, written = (
        np.median(find_player(policy, describe(task)).returns(COUNTED))
        for policy in ("still", str(run), "heuristic")
    )
    return bool(learned - still > written - learned)


def main() -> None:
    folders = [Path(each) for each in sys.argv[1:]]
    played = {}
    for task, (value, run) in best(folders).items():
        if not has_learned(run, task):
            print(f"{task}: none shipped, as {run} returns about what standing still does")
            continue
        save(load_run(run), file_of(task), SHIPPED)
        played[task] = {
            policy: find_player(policy, describe(task)).returns(COUNTED) for policy in SHOWN
        }
        print(f"{task}: {run}, {value:.0f} in the last tenth of training")
    write_returns(played)


if __name__ == "__main__":
    main()
