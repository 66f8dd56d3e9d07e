"""Ship the best agent for each task: python tools/policies.py STUDY...

A task's best run, of those of some finished studies, has the highest mean return in its last 64
episodes of training; a task that none has learned keeps what ships. Those episodes have other
starts than the evaluation's, so the returns that are written, which are of the last evaluation's
episodes, aren't what it was chosen by.
"""

import csv
import sys
from itertools import chain
from pathlib import Path

import numpy as np

from jbrep.jitterbug.tasks import TASKS
from jbrep.records.storage import write_whole
from jbrep.records.tables import write_csv
from jbrep.rl.files import EPISODES, FINISHED, last_returns, read_evaluations, read_run, runs_below
from jbrep.rl.policy import load_run, pack
from jbrep.rl.policy_file import COLUMNS, FOLDER, RETURNS, SHIPPED, Returns, shipped, shipped_file
from jbrep.stats.scale import LOOKING, STILL
from jbrep.studies.tables import References, read_tables

COUNTED = 100  # episodes
LAST = 64  # episodes of training, one of each robot


def score(run: Path) -> float:
    """Mean return of the last episodes of training."""
    with (run / EPISODES).open() as file:
        return float(np.mean([float(row["return"]) for row in csv.DictReader(file)][-LAST:]))


def best(folders: list[Path]) -> dict[str, tuple[float, Path]]:
    """The best run of each task, with its score."""
    found: dict[str, tuple[float, Path]] = {}
    for path in chain.from_iterable(map(runs_below, folders)):
        run = read_run(path)
        task = run.settings.task
        if run.status == FINISHED and task in TASKS:
            scored = (score(path), path)
            found[task] = max(found.get(task, scored), scored)
    return {task: found[task] for task in TASKS if task in found}


def main() -> None:
    folders = [Path(each) for each in sys.argv[1:]]
    played: dict[str, Returns] = {each.task: each.returns for each in shipped()}
    beside = References()
    for folder in folders:
        beside |= read_tables(folder).references
    for task, (value, run) in best(folders).items():
        learned = last_returns(read_evaluations(run))
        written, still = beside[task][LOOKING], beside[task][STILL]
        if {len(learned), len(written)} != {COUNTED}:
            sys.exit(
                f"{run} has {len(learned)} episodes at last, the scripted policy "
                f"{len(written)}: {COUNTED} of each are needed"
            )
        reached, least, most = (float(np.median(each)) for each in (learned, still, written))
        if reached - least < most - reached:
            print(f"{task}: none shipped, as {run} returns about what standing still does")
            continue
        write_whole(shipped_file(task), pack(load_run(run), SHIPPED))
        played[task] = {SHIPPED: np.array(learned), "heuristic": np.array(written)}
        print(f"{task}: {run}, {value:.0f} in training, at last; median {reached:.0f}")
    rows = (
        (task, policy, episode, f"{value:.3f}")
        for task, returns in played.items()
        for policy, values in returns.items()
        for episode, value in enumerate(values)
    )
    write_csv(FOLDER / RETURNS, [*COLUMNS], rows)


if __name__ == "__main__":
    main()
