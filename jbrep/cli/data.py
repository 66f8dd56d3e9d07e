"""Tasks, collecting data sets of them, and working with those."""

import shlex
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import click
from msgspec import Meta

from jbrep import api
from jbrep.cli.base import RESUMES, command, say, say_json
from jbrep.cli.signals import stoppable
from jbrep.dataset.layout import Layout
from jbrep.errors import InputError
from jbrep.parameters import AsJson, Hide, History, Out, Threads, described
from jbrep.text import counted, terminal_width


@command("env Hopper-v5")
def env(task: str, /, *, as_json: AsJson = False, **options: Annotated[Any, described]) -> None:
    """Show a task: its features, actions and time limit, and whether it is reproducible.

    TASK is one of the Jitterbug's, such as face_direction, or an id in Gymnasium's registry; for
    another package's, --import MODULE, or MODULE:ID, which imports it. The environment is made and
    played for some steps; that it terminates is only known where it did.
    """
    known = described(task, **options)
    assert known
    from jbrep.envs.card import card
    from jbrep.records.record import to_plain

    say_json(to_plain(known)) if as_json else say(card(known, terminal_width()))


@command("check Hopper-v5 --write features.toml")
def _check(as_json: AsJson = False, **options: Annotated[Any, api.check]) -> None:
    found = api.check(options.pop("task", None), **options)
    file = click.get_current_context().params.get("features")
    kinds = [[e.kind for e in t] for t in (found.advice.features, found.seen.task.whole.features)]
    if file and not options.get("write"):
        option, command = shlex.quote(f"--features={file}"), found.advice.command
        if kinds[0] == kinds[1]:  # the file needs no change
            command = command.split("\n")[-1].replace("--features=features.toml", option)
        command = command.replace(" --write", f" {option} --write")
        found = found._replace(advice=found.advice._replace(command=command))
    say_json(found.plain()) if as_json else say(found.text(terminal_width()))
    for what, path in (("features file", options.get("write")), ("page", options.get("out"))):
        if path:
            say(f"{what}: {path}", err=as_json)


@command("collect --task face_direction --steps 5M --out data/face")
def _collect(out: Path, **options: Annotated[Any, api.collect]) -> None:
    _report(out, lambda: api.collect(out=out, **options))


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
    if dataset.task.missing:
        count = int(dataset.episodes["missing"].sum())
        say(f"{counted(count, 'missing reading')} ({dataset.task.missing})", err=True)
    if rows := len(dataset) - before:
        say(f"{rows:,} rows in {seconds:,.0f} s, {rows / seconds:,.0f} a second")
    else:
        say("already complete: nothing to do")


def _report_size(out: Path, manifest: Any) -> None:
    task, every = manifest.task, manifest.task.timestep
    what = f"{counted(manifest.episodes, 'episode')} of {task.name}, {manifest.rows:,} rows"
    step = "" if every is None else f", {every:.4g} s apart"
    say(f"{what}{step}, {manifest.bytes / 1e6:,.1f} MB in {out}")


@command("data info data/face")
def info(data: Path, /, *, as_json: AsJson = False) -> None:
    """Show what a data set holds."""
    from jbrep.dataset import Dataset

    known = Dataset(data)
    say_json(known.describe()) if as_json else say(known.card(terminal_width()))


@command("data verify data/face --replay 50")
def verify(
    data: Path, /, *, replay: Annotated[int, Meta(ge=0, le=10**9)] = 0, threads: Threads = None
) -> bool:
    """Check the hash of every shard, and the ranges of what is in them.

    Prints a line for each problem; the exit code is 1 if there are any.

    Args:
        replay: episodes to simulate again and compare bit for bit.
    """
    from jbrep.collecting.replay import replay_problems
    from jbrep.dataset import Dataset
    from jbrep.dataset.manifest import find_problems

    if _say_all(find_problems(data)):
        return True
    dataset = Dataset(data)
    if _say_all(replay_problems(dataset, replay, threads)):
        return True
    manifest = dataset.manifest
    shards = counted(len(manifest.shards), "shard")
    unfinished = "" if manifest.complete else "; unfinished"
    say(f"{data}: no problems in {len(dataset):,} rows, {shards}{unfinished}")
    if replay:
        say(f"{counted(replay, 'episode')} simulated again: equal in every bit")
    return False


def _say_all(lines: Iterable[str]) -> bool:
    """Print lines as they come; whether there were any."""
    any_said = False
    for line in lines:
        say(line)
        any_said = True
    return any_said


@command("data derive data/face --hide 'velocity_*' --history 4 --out data/seen")
def derive(
    data: Path,
    /,
    out: Out,
    *,
    hide: Hide = (),
    history: History = 1,
    reward: Annotated[str, Meta(extra={"metavar": "MODULE:FUNCTION", "is_code": True})] = "",
) -> None:
    """Make another data set of the same motion, with other rewards, hidden features or a history.

    `hide` leaves features out, `history` adds those of the steps before, and the actions since: an
    encoder of these estimates what can't be measured. `reward` is a function of your own, of what
    is seen before anything is hidden.

    Args:
        reward: a function of an episode's observations (n, d) and actions (n, k) that returns
            rewards (n,); it is run.
    """
    from jbrep.collecting.derive import derive as run
    from jbrep.envs.names import is_code

    if not (hide or reward or history > 1):
        raise InputError("give --hide, --history or --reward")
    if reward and not is_code(reward):
        raise InputError(f"--reward {reward} must be MODULE:FUNCTION")
    _report(out, lambda: run(data, out, hide, history, reward))


@command("data export data/face --to parquet --out face.parquet")
def export(data: Path, /, to: str, out: Path) -> None:
    """Write a data set in another tool's format.

    For minari, `out` is a folder of Minari data sets, as MINARI_DATASETS_PATH names it.

    Args:
        to: one of minari, parquet, npz and lerobot.
        out: a new folder, or a file that ends in .npz or .parquet.
    """
    from jbrep.dataset import Dataset
    from jbrep.dataset.formats import export as run

    with stoppable("the export was discarded"):
        say(f"open it with {run(Dataset(data), to, out)}")


@command("data import D4RL/hopper/expert-v0 --out data/hopper")
def import_data(
    *source: str,
    out: Path,
    layout: Path | None = None,
    **options: Annotated[Any, Layout, described],
) -> None:
    """Make a data set of other tools' data, or of logs.

    SOURCE is a file (.csv, .tsv, .txt, .parquet, .npz, .hdf5, .h5, .bag, .mcap, .db3), the folder
    of a bag, of a LeRobot or a Minari data set, or the id of the latter in MINARI_DATASETS_PATH; an
    episode ends with each of several. Without --task, the task is the one that the source names, or
    is made from the data alone. See docs/logs.md, and docs/data-format.md for what is known by its
    name.

    Args:
        out: a new folder.
        layout: a TOML file with the options from --observations to --fill.
    """
    from jbrep.dataset.formats import open_sources
    from jbrep.dataset.formats.writer import write
    from jbrep.envs.names import is_code

    columns = {n: options.pop(n) for n in Layout.__struct_fields__ if n in options}
    known = _layout(layout, columns)
    reward = known.reward if is_code(known.reward) else ""
    declared = {name: options[name] for name in ("features", "missing") if name in options}
    if "task" not in options:
        if {"hide", "history"} & {*options}:
            raise InputError(
                "--hide and --history need a --task here: import without them, and give them to "
                "jbrep data derive"
            )
        options = {name: each for name, each in options.items() if name not in declared}
    task = described(**options)
    with stoppable("nothing was imported"):
        missing = declared.get("missing") or (task.missing if task else "") or ""
        opened = open_sources(source, known, missing)
        manifest = write(opened, out, task, **{} if task else declared, reward=reward)
    for note in opened.notes():
        say(note)
    for (noun, what), count in opened.changes().items():
        say(f"{counted(count, noun)} {what}")
    if manifest.settings.unrewarded:
        say("no rewards: add some with --reward COLUMN or module:function", err=True)
    if not (task or opened.task):
        line = f"{manifest.task.name}: {opened.why_no_task}; jbrep clone learns from it, rl can't"
        say(line, err=True)
    _report_size(out, manifest)


def _layout(path: Path | None, given: dict[str, Any]) -> Layout:
    """What the columns are by a file, and by options before it."""
    from jbrep.records.document import read_toml
    from jbrep.records.record import from_plain, to_plain

    from_file = read_toml(path) if path else {}
    try:
        return from_plain({**from_file, **to_plain(given)}, Layout)
    except InputError as error:
        raise InputError(f"{path}: {error}" if path else f"{error}") from None
