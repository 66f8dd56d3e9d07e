"""Recordings of whatever a user names: an episode, an encoder or a study."""

import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import FULL, find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.file import SUFFIX as ENCODER_SUFFIX
from jbrep.encoders.shipped import find_alone, source_of
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.inspection.blueprint import TRAINING_STEP, curves_layout
from jbrep.inspection.episode import record_episode, record_traversal
from jbrep.inspection.recording import SUFFIX, Recording, check_out, palette
from jbrep.play.rollout import Rollout
from jbrep.play.sources import find_episode, is_trained, run_folder
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER, check_begun, is_run
from jbrep.stats import RunCurve
from jbrep.stats.bootstrap import Array
from jbrep.stats.runs import in_order, with_failure_returns
from jbrep.study.tables import has_runs, read_curves

FOLDER = Path("inspect")  # of recordings without an --out
_POLICY = "uniform"  # plays the episode that an encoder alone is shown on
_RUN_WIDTH = 1.0  # [points]
_MEDIAN_WIDTH = 4.0  # [points]


def inspect(
    source: str | None = None,
    episode: int | None = None,
    task: Task | None = None,
    encoder: Any = None,
    traverse: bool = False,
    out: Path | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> Path:
    """Write the Rerun recording of an episode, of a latent's units, or of a study's curves.

    Args:
        source: a data set's folder, a run's, or one with several runs below; an encoder's file, or
            a policy's name; an encoder alone is shown on an episode under uniformly random actions.
            A run that is not over plays its last checkpoint.
        episode: its number, from 0; the first if not given.
        task: of a policy or encoder by its name; a run plays it instead of its own.
        encoder: a file, the name of one that ships, code, or an object that encodes, as
            `jbrep.encoders.find` takes it; a run's own if not given.
        traverse: whether to show what each unit of the latent moves, instead of the episode.
        out: the .rrd file; one in inspect/, named after its content, if not given.
        tell: called with a line on where an encoder is from, and on a robot that can't be shown.

    Returns:
        The file.
    """
    if out:
        check_out(out)
    if source and _is_other_folder(Path(source)) and has_runs(Path(source)):
        if encoder is not None or traverse or task or episode is not None:
            raise InputError(
                f"{source} holds several runs, whose training curves are shown without --episode, "
                "--task, --encoder and --traverse: give one run's folder to see an episode"
            )
        out = out or _default(source, "curves")
        record_curves(read_curves(Path(source)), source, out)
        return out
    rollout, shown = _find(source, episode or 0, task, encoder)
    if isinstance(encoder, (str, Path)):
        tell(f"encoder: {source_of(encoder, rollout.task)}")
    if rollout.note:
        tell(rollout.note)
    if traverse and not shown:
        raise InputError("--traverse moves the units of a latent: give an --encoder")
    if out is None:
        more = [*([shown.name] if shown else []), *(["traverse"] if traverse else [])]
        out = _default(source, rollout.task.slug, f"episode-{episode or 0}", *more)
    if shown and traverse:
        record_traversal(rollout, out, shown)
    else:
        record_episode(rollout, out, shown)
    return out


def _is_other_folder(path: Path) -> bool:
    """Whether this is a folder, but no data set and no run."""
    is_folder = exists(path) and path.is_dir()
    return is_folder and not exists(path / MANIFEST) and not is_run(path)


def _find(
    source: str | None, episode: int, task: Task | None, encoder: Any
) -> tuple[Rollout, BaseEncoder | None]:
    """The episode, and the encoder to show with it."""
    if source is None or (source.endswith(ENCODER_SUFFIX) and not is_trained(source)):
        if (source is None) == (encoder is None):
            raise InputError("give a SOURCE to inspect, or one encoder with its --task")
        shown = find_alone(encoder if source is None else source, task)
        shown.check_task(task or shown.task)
        return find_episode(_POLICY, episode, task or shown.task), shown
    if _is_other_folder(Path(source)):
        check_begun(Path(source))
        raise InputError(
            f"{source} is no data set, no run with a policy or checkpoint, and holds no finished "
            "run: jbrep collect makes a data set, jbrep rl a run"
        )
    rollout = find_episode(source, episode, task, _acting(run_folder(source), encoder))
    return rollout, rollout.encoder if encoder is None else find(encoder, rollout.task)


def _acting(folder: Path | None, encoder: Any) -> Any:
    """The given encoder, if a run needs it to act: an object, where the run's folder has none."""
    is_object = encoder is not None and not isinstance(encoder, (str, Path))
    return encoder if is_object and folder and not exists(folder / ENCODER) else None


def _default(source: str | None, first: str, *more: str) -> Path:
    """A file named after its content, each word once; of a path the last three parts count."""
    parts = Path((source or _POLICY).removesuffix(ENCODER_SUFFIX)).parts
    named = [part for part in parts if part not in ("/", ".", "..")][-3:]
    words = [re.sub(r"[^\w.=-]+", "-", part) for part in dict.fromkeys((first, *named, *more))]
    return FOLDER / f"{'-'.join(words)}{SUFFIX}"


def median_curve(runs: Sequence[RunCurve]) -> tuple[NDArray[np.int64], Array]:
    """Median over runs at the steps at which all were evaluated.

    A failed run counts as its failure_return from the step at which it failed.
    """
    whole = [run.steps for run in runs if run.failed_at is None] or [runs[0].curve()[0]]
    steps: NDArray[np.int64] = reduce(np.intersect1d, whole)
    each = [np.interp(steps, *run.curve()) for run in runs]
    return steps, np.median(each, axis=0)


def record_curves(runs: Sequence[RunCurve], source: str, path: Path) -> None:
    """Write the training curves of runs in a folder, with a colour for each representation."""
    labels = defaultdict(list)
    for run in sorted(with_failure_returns(runs), key=lambda run: (run.label, run.seed)):
        labels[run.label].append(run)
    representations = in_order((run.representation for run in runs), FULL)
    colours = dict(zip(representations, palette(len(representations)), strict=True))
    numbers = [number for run in runs for number in (run.steps, run.returns)]
    recording = Recording(source, _about(source, labels), *numbers)
    for label, group in labels.items():
        name = group[0].representation
        curves = {f"seed-{run.seed}": (run.curve(), _RUN_WIDTH) for run in group}
        curves["median"] = median_curve(group), _MEDIAN_WIDTH
        for curve, ((steps, returns), width) in curves.items():
            times = [rr.TimeColumn(TRAINING_STEP, sequence=steps)]
            look = [name], [colours[name]], width
            recording.send_series(f"{label}/{curve}", times, returns[:, None], *look)
    groups = sorted({f"{run.task}/{run.algorithm}" for run in runs})
    recording.write(path, curves_layout(groups, max(int(run.curve()[0][-1]) for run in runs)))


def _about(source: str, labels: dict[str, list[RunCurve]]) -> str:
    """The runs and their final returns, as Markdown."""
    lines = [f"# {source}", "", "| runs | seeds | median return at the end |", "|---|---|---|"]
    for label, runs in labels.items():
        last = np.median([run.curve()[1][-1] for run in runs])
        lines.append(f"| {label} | {len(runs)} | {last:.0f} |")
    return "\n".join(lines)
