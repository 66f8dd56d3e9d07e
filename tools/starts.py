"""What the last policies of a study's runs return from many starts.

python tools/starts.py runs/answer-move-to-position results/answer-move-to-position/starts.csv

Runs of the programme are evaluated from five starts, always the same: enough to compare agents
there, and few to stand for all. This plays their policies, and those that don't learn, from many,
the five among them; what the table has already isn't played again. Then it prints the mean over
runs of each representation, and the gain as a share of the baseline's, with 95 % intervals.
"""

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from joblib import cpu_count

from jbrep.play import references
from jbrep.play.sources import find_player
from jbrep.progress import Progress
from jbrep.rl.files import RunRecord, read_run, runs_below
from jbrep.stats.intervals import LEVEL, Bounds, mean_within, share_of_gain
from jbrep.stats.scale import best_blind
from jbrep.text import interval, table
from jbrep.training.trainer import single_torch_thread

BASELINE = "coordinates"


class Start(NamedTuple):
    """The return of an episode; seed is the run's, None of a policy that doesn't learn."""

    representation: str
    seed: int | None
    episode: int
    value: float


def played(folder: Path, starts: int) -> list[Start]:
    """The episodes of a run's policy."""
    settings = read_run(folder).settings
    with single_torch_thread():
        returns = find_player(str(folder)).returns(starts, threads=1)
    key = settings.representation, settings.seed
    return [Start(*key, i, float(value)) for i, value in enumerate(returns)]


def play(runs: dict[Path, RunRecord], out: Path, starts: int) -> pd.DataFrame:
    """The table, of all runs; each is written as soon as it is known."""
    known = pd.read_csv(out) if out.exists() else table_of([])
    rows = [Start(*row) for row in known.itertuples(index=False, name=None)]
    there = known.groupby(["representation", "seed"], dropna=False).size()
    if (there != starts).any():
        raise SystemExit(f"{out} has other numbers of starts than {starts}: choose another file")
    missing = [
        folder
        for folder, run in runs.items()
        if (run.settings.representation, run.settings.seed) not in there.index
    ]
    if not rows:
        task = next(iter(runs.values())).settings.environment
        for policy in references.policies_of(task):
            returns = enumerate(references.play(policy, task, starts))
            rows += [Start(policy, None, episode, value) for episode, value in returns]
    with ProcessPoolExecutor(cpu_count()) as pool, Progress(total=len(missing), unit="run") as bar:
        for each in pool.map(played, missing, [starts] * len(missing)):
            rows += each
            table_of(rows).round(3).to_csv(out, index=False)
            bar.update()
    return table_of(rows)


def table_of(rows: list[Start]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=Start._fields).astype({"seed": "Int64"})


def cells(known: pd.DataFrame, bounds: Bounds) -> Iterator[tuple[str, str, str]]:
    """A row for each representation, the baseline first, and for each policy."""
    runs, policies = known[known["seed"].notna()], known[known["seed"].isna()]
    by_policy = policies.groupby("representation", sort=False)["value"].mean().to_dict()
    finals = runs.pivot_table("value", "seed", "representation")
    blind = best_blind(by_policy)
    assert blind
    for name in sorted(finals, key=lambda name: (name != BASELINE, name)):
        x, y = finals[[name, BASELINE]].dropna().to_numpy(float).T  # of the seeds of both
        share = interval(share_of_gain(x, y, by_policy[blind]).tolist(), ".2f")
        own = finals[name].dropna().to_numpy(float)
        mean = interval(mean_within(own, bounds, LEVEL).tolist(), ".0f")
        yield name, mean, "" if name == BASELINE else share
    for policy, value in by_policy.items():
        yield policy, f"{value:.0f}", ""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--starts", type=int, default=50)
    given = parser.parse_args()
    runs = {folder: read_run(folder) for folder in runs_below(given.study)}
    known = play(runs, given.out, given.starts)
    task = next(iter(runs.values())).settings.environment
    bounds = Bounds.of(task.return_floor, task.return_ceiling)
    print(table(("agents on", "final return", f"of {BASELINE}'s gain"), cells(known, bounds)))


if __name__ == "__main__":
    main()
