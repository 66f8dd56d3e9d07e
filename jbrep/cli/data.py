"""Collecting, and what is done with a data set."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, GOES_ON, example, printable, stoppable

_threads = click.option(
    "--threads", type=click.IntRange(1, 4096), help="To work on; all cores if not given."
)
_lanes = click.option(
    "--lanes",
    type=click.IntRange(1, 100_000),
    default=100,
    show_default=True,
    help="Robots stepped at once.",
)
_data = click.argument("data", type=click.Path(path_type=Path))


@click.command(epilog=example("jbrep collect --task face_direction --steps 5M --out data/face"))
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option("--steps", required=True, type=COUNT, help="Control steps, in whole episodes.")
@click.option("--seed", default=0, show_default=True, help="Root of every episode's seed.")
@click.option(
    "--policy",
    default="uniform",
    show_default=True,
    help="uniform, heuristic, constant:drive=0.5 or ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3.",
)
@click.option("--store-state", is_flag=True, help="Keep qpos and qvel, for jbrep data derive.")
@click.option("--shard-episodes", default=100, show_default=True, help="Episodes in a shard.")
@_lanes
@_threads
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A folder.")
def collect(
    task: str,
    steps: int,
    seed: int,
    policy: str,
    store_state: bool,
    shard_episodes: int,
    lanes: int,
    threads: int | None,
    out: Path,
) -> None:
    """Collect the states that a policy visits.

    The same command goes on with what it began; a finished data set is left as it is. Neither
    lanes nor threads change the data.
    """
    from jbrep.collect import collect as run
    from jbrep.collect.policies import parse_policy, policy_settings
    from jbrep.dataset import Settings

    how = policy_settings(parse_policy(policy))
    settings = Settings(
        task=task,
        policy=how,
        steps=steps,
        seed=seed,
        shard_episodes=shard_episodes,
        store_state=store_state,
    )
    with stoppable(GOES_ON):
        _tell(out, run(settings, out, lanes, threads))


def _tell(out: Path, written: Any) -> None:
    """What is in the folder now, and how fast it came there."""
    manifest, rows, seconds = written
    size = sum(entry.bytes for entry in manifest.shards) / 1e6
    total = sum(entry.rows for entry in manifest.shards)
    settings = manifest.settings
    what = f"{settings.episodes:,} episodes of {settings.task}, {total:,} rows, {size:,.1f} MB"
    click.echo(f"{what} in {out}")
    if rows:
        click.echo(f"{rows:,} rows in {seconds:,.0f} s, {rows / seconds:,.0f} a second")
    else:
        click.echo("it was complete already: nothing was done")


@click.group()
def data() -> None:
    """Look at, check, mend, derive and export data sets."""


@data.command(epilog=example("jbrep data info data/face"))
@_data
def info(data: Path) -> None:
    """Show what a data set holds."""
    from jbrep.dataset import Dataset
    from jbrep.dataset.card import card

    click.echo(card(Dataset(data)))


@data.command(epilog=example("jbrep data verify data/face --replay 50"))
@_data
@click.option("--replay", default=0, help="Episodes to simulate again and compare bit for bit.")
@_threads
@click.pass_context
def verify(ctx: click.Context, data: Path, replay: int, threads: int | None) -> None:
    """Check every hash, shape, number and range.

    Exit code 1 if anything is wrong, with a line for each problem.
    """
    from jbrep.collect.replay import replay_problems
    from jbrep.dataset import Dataset
    from jbrep.dataset.verify import find_problems

    problems = 0
    for problem in find_problems(data):
        click.echo(printable(problem))
        problems += 1
    if not problems:
        dataset = Dataset(data)
        for problem in replay_problems(dataset, replay, threads):
            click.echo(printable(problem))
            problems += 1
    if problems:
        ctx.exit(1)
    manifest = dataset.manifest
    shards = f"{len(manifest.shards)} of {manifest.settings.num_shards} shards"
    click.echo(
        f"{data}: {len(dataset):,} rows in {shards}, every hash, shape, number and range as it "
        "should be"
    )
    if replay:
        click.echo(f"{replay} episodes simulated again: equal in every bit")


@data.command(epilog=example("jbrep data repair data/face"))
@_data
@_lanes
@_threads
def repair(data: Path, lanes: int, threads: int | None) -> None:
    """Make damaged and missing files again, as they were."""
    from jbrep.collect.repair import repair as run

    with stoppable(GOES_ON):
        done = 0
        for line in run(data, lanes, threads):
            click.echo(printable(line))
            done += 1
    if not done:
        click.echo(f"{data} is whole: nothing to repair")


@data.command(
    epilog=example("jbrep data derive data/face --task move_in_direction --out data/move")
)
@_data
@click.option("--task", required=True, help="The task to observe and reward.")
@click.option("--store-state", is_flag=True, help="Keep qpos and qvel.")
@_threads
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A folder.")
def derive(data: Path, task: str, store_state: bool, threads: int | None, out: Path) -> None:
    """Make another task's data set of the same motion.

    Nothing is simulated again, and it equals collecting that task with the same settings, bit for
    bit. The data set needs its states (collect --store-state) and a policy that doesn't act on
    observations.
    """
    from jbrep.collect.derive import derive as run

    with stoppable(GOES_ON):
        _tell(out, run(data, task, out, store_state, threads))


@data.command(epilog=example("jbrep data export data/face --to parquet --out face.parquet"))
@_data
@click.option("--to", required=True, help="minari, parquet or npz.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new file or folder.")
def export(data: Path, to: str, out: Path) -> None:
    """Write a data set in another tool's format.

    For minari, --out is a folder of Minari data sets, as MINARI_DATASETS_PATH names it.
    """
    from jbrep.dataset import Dataset
    from jbrep.dataset.export import export as run

    with stoppable("nothing is left of it"):
        click.echo(f"open it with {run(Dataset(data), to, out)}")
