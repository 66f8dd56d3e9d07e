"""Collecting data sets, and working with them."""

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import PATH, RESUMES, as_json
from jbrep.cli.completion import complete_task
from jbrep.cli.environment import (
    environment_options,
    given_task,
    import_option,
    needed_task,
    needed_task_option,
    retries_option,
    task_option,
    threads_option,
    view_options,
)
from jbrep.cli.options import record_options
from jbrep.cli.output import echo_json, echo_text, say
from jbrep.cli.signals import deferred_stop, stoppable
from jbrep.dataset.layout import Layout
from jbrep.dataset.settings import CollectSettings
from jbrep.errors import InputError
from jbrep.text import counted, terminal_width

if TYPE_CHECKING:
    from jbrep.dataset import Dataset

_lanes = click.option(
    "--lanes",
    type=click.IntRange(1, 100_000),
    default=100,
    show_default=True,
    help="Environments of a batch, stepped at once.",
)
_data = click.argument("data", type=PATH)


@click.command(epilog="Example: jbrep collect --task face_direction --steps 5M --out data/face")
@needed_task_option
@record_options(CollectSettings, shard_episodes=None)
@click.option(
    "--policy",
    default="uniform",
    show_default=True,
    help="uniform, constant:drive=0.5, ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3, for the "
    "Jitterbug heuristic and trained (see jbrep policies); the folder of a run; or several with "
    "weights, of which each episode has one: uniform:0.5+runs/a:0.5.",
)
@_lanes
@threads_option
@retries_option
@click.option("--backend", default="local", show_default=True, help="local, or ray for a cluster.")
@click.option("--out", required=True, type=PATH, help="A folder.")
@environment_options
def collect(out: Path, **options: Any) -> None:
    """Collect the states that a policy visits.

    The same command resumes an unfinished data set and leaves a finished one as it is; with more
    --steps it extends it, to the data that one command with as many collects. The numbers of lanes
    and threads and the backend don't change the data. A robot that exists once needs --threads 1.
    Whole shards are kept whatever happens. The policy of a run is kept with the data as it is at
    the start, also if the run goes on.
    """
    from jbrep import api

    _report(out, lambda: api.collect(needed_task(options), out, **options))


def _report(out: Path, write: Callable[[], object]) -> None:
    """Let a data set be written; print what the folder holds then, and how fast it was written."""
    from jbrep.dataset import Dataset
    from jbrep.dataset.manifest import MANIFEST, read_manifest
    from jbrep.records.storage import exists

    before = read_manifest(out).rows if exists(out / MANIFEST) else 0
    began = time.monotonic()
    with stoppable(RESUMES):
        write()
    seconds, dataset = time.monotonic() - began, Dataset(out)
    _report_size(out, dataset.manifest)
    _tell_missing(dataset)
    if rows := len(dataset) - before:
        click.echo(f"{rows:,} rows in {seconds:,.0f} s, {rows / seconds:,.0f} a second")
    else:
        click.echo("it was complete already: nothing was done")


def _tell_missing(dataset: "Dataset") -> None:
    """Say how many readings were missing."""
    if dataset.task.missing:
        count = int(dataset.episodes["missing"].sum())
        say(f"{counted(count, 'missing reading')} ({dataset.task.missing})", err=True)


def _report_size(out: Path, manifest: Any) -> None:
    """Print what the folder holds."""
    size = manifest.bytes / 1e6
    episodes = counted(manifest.episodes, "episode")
    what = f"{episodes} of {manifest.task.name}, {manifest.rows:,} rows"
    say(f"{what}, {size:,.1f} MB in {out}")


@click.group(epilog="Example: jbrep data info data/face")
def data() -> None:
    """Inspect, repair, derive, import and export data sets."""


@data.command(epilog="Example: jbrep data info data/face")
@_data
@as_json
def info(data: Path, as_json: bool) -> None:
    """Show what a data set holds."""
    from jbrep.dataset import Dataset

    if as_json:
        echo_json(Dataset(data).describe())
        return
    echo_text(Dataset(data).card(terminal_width()))


@data.command(epilog="Example: jbrep data verify data/face --replay 50")
@_data
@click.option("--replay", default=0, help="Episodes to simulate again and compare bit for bit.")
@import_option
@threads_option
@click.pass_context
def verify(ctx: click.Context, data: Path, replay: int, threads: int | None) -> None:
    """Check the hash of every shard, and the ranges of what is in them.

    Prints a line for each problem; the exit code is 1 if there are any.
    """
    from jbrep.collect.replay import replay_problems
    from jbrep.dataset import Dataset
    from jbrep.dataset.manifest import find_problems

    if _say_all(find_problems(data)):
        ctx.exit(1)
    dataset = Dataset(data)
    if _say_all(replay_problems(dataset, replay, threads)):
        ctx.exit(1)
    manifest = dataset.manifest
    shards = counted(len(manifest.shards), "shard")
    unfinished = "" if manifest.complete else "; unfinished"
    say(f"{data}: no problems in {len(dataset):,} rows, {shards}{unfinished}")
    if replay:
        click.echo(f"{counted(replay, 'episode')} simulated again: equal in every bit")


def _say_all(lines: Iterable[str]) -> bool:
    """Print lines as they come; whether there were any."""
    any_said = False
    for line in lines:
        say(line)
        any_said = True
    return any_said


@data.command(epilog="Example: jbrep data repair data/face")
@_data
@import_option
@_lanes
@threads_option
def repair(data: Path, lanes: int, threads: int | None) -> None:
    """Make damaged and missing shards again from their seeds."""
    from jbrep.collect.replay import repair as run
    from jbrep.play.sources import kept_policy

    with stoppable(RESUMES):
        repaired = _say_all(run(data, lanes, threads, kept_policy(data)))
    if not repaired:
        say(f"{data} is whole: nothing to repair")


@data.command(
    epilog="Example: jbrep data derive data/face --task move_in_direction --out data/move"
)
@_data
@click.option(
    "--task",
    shell_complete=complete_task,
    help="Another of the Jitterbug's tasks to observe and reward.",
)
@record_options(CollectSettings, "store_state")
@view_options
@import_option
@click.option(
    "--reward",
    default="",
    metavar="MODULE:FUNCTION",
    help="For rewards (n,) of the observations (n, d) and actions (n, k) of an episode; is run.",
)
@threads_option
@click.option("--out", required=True, type=PATH, help="A folder.")
def derive(
    data: Path,
    task: str | None,
    store_state: bool,
    hide: tuple[str, ...],
    history: int,
    reward: str,
    threads: int | None,
    out: Path,
) -> None:
    """Make another data set of the same motion.

    It is of another task, has other rewards, or less or more to see. Another task's equals
    collecting that task with the same settings, bit for bit, without simulating again; the source
    needs its states (collect --store-state) and a policy that doesn't depend on observations. The
    rest can be changed in any data set: --hide leaves features out, --history adds those of the
    steps before, and the actions since: an encoder of these estimates what can't be measured.
    --reward is a function of your own, of what is seen before anything is hidden.
    """
    from jbrep.collect.derive import derive as run
    from jbrep.collect.derive import derive_view
    from jbrep.envs.names import import_code, is_code

    if bool(task) == (bool(hide or reward) or history > 1):
        raise InputError("give a --task, or else --hide, --history or --reward")
    if store_state and not task:
        raise InputError("--store-state is for --task: else states stay as the source has them")
    if threads and not task:
        raise InputError("--threads is for --task: nothing else is simulated")
    if reward and not is_code(reward):
        raise InputError(f"--reward {reward} must be MODULE:FUNCTION")
    import_code(reward)
    if task:
        _report(out, lambda: run(data, task, out, store_state, threads))
    else:
        _report(out, lambda: derive_view(data, out, hide, history, reward))


@data.command(epilog="Example: jbrep data export data/face --to parquet --out face.parquet")
@_data
@import_option
@click.option("--to", required=True, help="minari, parquet, npz or lerobot.")
@click.option(
    "--out", required=True, type=PATH, help="A new folder, or a file that ends in .npz or .parquet."
)
def export(data: Path, to: str, out: Path) -> None:
    """Write a data set in another tool's format.

    For minari, --out is a folder of Minari data sets, as MINARI_DATASETS_PATH names it.
    """
    from jbrep.dataset import Dataset
    from jbrep.dataset.formats import export as run
    from jbrep.dataset.formats import load_format

    with stoppable("the export was discarded"):
        with deferred_stop():
            load_format(to)
        click.echo(f"open it with {run(Dataset(data), to, out)}")


@data.command("import", epilog="Example: jbrep data import D4RL/hopper/expert-v0 --out data/hopper")
@click.argument("source", nargs=-1, required=True)
@task_option
@click.option("--out", required=True, type=PATH, help="A new folder.")
@record_options(Layout, fill=None)
@click.option(
    "--layout", type=PATH, help="A TOML file with the options from --observations to --fill."
)
@environment_options
def import_(source: tuple[str, ...], out: Path, **options: Any) -> None:
    """Make a data set of other tools' data, or of logs.

    SOURCE is a file (.csv, .tsv, .txt, .parquet, .npz, .hdf5, .h5, .bag, .mcap, .db3), the folder
    of a bag, of a LeRobot or a Minari data set, or the id of the latter in MINARI_DATASETS_PATH; an
    episode ends with each of several. Without --task, the task is the one that the source names, or
    is made from the data alone. See docs/logs.md, and docs/data-format.md for what is known by its
    name.
    """
    from jbrep.dataset.formats import load_reader, open_sources
    from jbrep.dataset.formats.writer import write
    from jbrep.envs.names import import_code, is_code

    import_code(options["reward"])
    layout = _layout(options)
    reward = layout.reward if is_code(layout.reward) else ""
    told = {name: options[name] for name in ("features", "missing")}
    if options["task"] is None:
        if options["hide"] or options["history"] > 1:
            raise InputError(
                "--hide and --history need a --task here: import without them, and give them to "
                "jbrep data derive"
            )
        options |= dict.fromkeys(told)  # they can be said of data alone
    task = given_task(options)
    with stoppable("nothing was imported"):
        with deferred_stop():
            for each in source:
                load_reader(each)
        missing = told["missing"] or (task.missing if task else "") or ""
        opened = open_sources(source, layout, missing)
        said = {} if task else _given(told)
        manifest = write(opened, out, task, **said, reward=reward)
    for note in opened.notes():
        say(note)
    for (noun, what), count in opened.changes().items():
        say(f"{counted(count, noun)} {what}")
    if manifest.settings.unrewarded:
        say("no rewards: what needs some will say so; --reward can make them", err=True)
    if not (task or opened.task):
        line = f"{manifest.task.name} is made from the data alone: {opened.why_no_task}"
        say(line, err=True)
    _report_size(out, manifest)


def _layout(options: dict[str, Any]) -> Layout:
    """What the columns are by a file, and by options before it; they are taken out."""
    from jbrep.records.document import read_toml
    from jbrep.records.record import from_plain

    given = {name: options.pop(name) for name in Layout.__struct_fields__}
    path = options.pop("layout")
    said = {name: value for name, value in given.items() if value not in (None, "")}
    told = read_toml(path) if path else {}
    try:
        return from_plain({**told, **said}, Layout)
    except InputError as error:
        raise InputError(f"{path}: {error}" if path else f"{error}") from None


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
