"""From what a user names to its recording."""

import re
from pathlib import Path

from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import Encoder, find, load
from jbrep.encoders.file import SUFFIX as ENCODER_SUFFIX
from jbrep.encoders.shipped import find_alone
from jbrep.errors import InputError
from jbrep.files.storage import exists
from jbrep.inspection.curves import record_curves
from jbrep.inspection.episode import record_episode
from jbrep.inspection.recording import SUFFIX, check_out
from jbrep.inspection.traversal import record_traversal
from jbrep.jitterbug.tasks import get_task
from jbrep.rl.files import ENCODER, RUN
from jbrep.rollouts.rollout import Rollout
from jbrep.rollouts.sources import find_episode
from jbrep.study.results import has_runs, read_runs

FOLDER = Path("inspect")  # of recordings whose file isn't named
_POLICY = "uniform"  # of an encoder's episode


def inspect(
    source: str | None = None,
    episode: int | None = None,
    task: str | None = None,
    encoder: str | None = None,
    traverse: bool = False,
    out: Path | None = None,
) -> Path:
    """Write the Rerun recording of an episode, of a latent's units, or of a study's curves.

    Args:
        source: a data set's folder, a run's, or one with several runs below; an encoder's file, or
            a policy's name; an encoder alone is shown on an episode under uniformly random drives.
        episode: which one, from 0; the first if not given.
        task: of a policy or encoder by its name.
        encoder: a file, or the name of one that ships; a run's own if not given.
        traverse: what each unit of the latent moves, in the place of the episode.
        out: the .rrd file; one in inspect/, named after its content, if not given.

    Returns:
        The file.

    Raises:
        InputError: any of these can't be found, or don't fit together, or something other than a
            recording stands where it is to be written.
    """
    if out:
        check_out(out)
    if source and _is_study(Path(source)):
        if encoder or traverse or task or episode is not None:
            raise InputError(
                f"{source} holds several runs: of these training curves are shown, without "
                "--episode, --task, --encoder and --traverse; name one run for an episode"
            )
        out = out or _default("curves", *_words(source))
        record_curves(read_runs(Path(source)), source, out)
        return out
    rollout, shown = _find(source, episode or 0, task, encoder)
    name = [rollout.task.name, *_words(source), f"episode-{episode or 0}"]
    if shown:
        name.append(shown.name)
    if not traverse:
        out = out or _default(*name)
        record_episode(rollout, out, shown)
    elif shown:
        out = out or _default(*name, "traverse")
        record_traversal(rollout, out, shown)
    else:
        raise InputError("--traverse moves the units of a latent: give an --encoder")
    return out


def _is_study(folder: Path) -> bool:
    """Whether runs stand below it, and it is none itself."""
    if not _is_folder(folder) or exists(folder / MANIFEST) or exists(folder / RUN):
        return False
    return has_runs(folder)


def _is_folder(path: Path) -> bool:
    return exists(path) and path.is_dir()


def _find(
    source: str | None, episode: int, task: str | None, encoder: str | None
) -> tuple[Rollout, Encoder | None]:
    """The episode, and the encoder to show with it."""
    if source is None or source.endswith(ENCODER_SUFFIX):
        if (source is None) == (encoder is None):
            raise InputError("give a SOURCE to inspect, or one encoder with its --task")
        shown = _load(source or encoder or "", task)
        return find_episode(_POLICY, episode, shown.header["task"]), shown
    folder = Path(source)
    if _is_folder(folder) and not exists(folder / MANIFEST) and not exists(folder / RUN):
        raise InputError(
            f"{source} is no data set and no run, and none is over below it: jbrep collect makes a "
            "data set, jbrep rl a run"
        )
    rollout = find_episode(source, episode, task)
    if task not in (None, rollout.task.name):
        raise InputError(f"{source} is of {rollout.task.name}, not of {task}")
    if encoder:
        return rollout, find(encoder, rollout.task.name)
    return rollout, _own(folder)


def _load(encoder: str, task: str | None) -> Encoder:
    """An encoder whose features are those of its own task."""
    found = find_alone(encoder, task)
    found.check_task(get_task(found.header["task"]))
    return found


def _own(folder: Path) -> Encoder | None:
    """What a trained run sees through, unless it sees all."""
    if not exists(folder / RUN):
        return None
    encoder = load(folder / ENCODER)
    return None if encoder.header["kind"] == "identity" else encoder


def _words(source: str | None) -> tuple[str, ...]:
    """The end of a path, enough to tell runs apart."""
    path = Path((source or _POLICY).removesuffix(ENCODER_SUFFIX))
    return tuple(part for part in path.parts if part not in ("/", ".", ".."))[-3:]


def _default(*parts: str) -> Path:
    """A file named after its content, each word once."""
    words = [re.sub(r"[^\w.=-]+", "-", part) for part in dict.fromkeys(parts)]
    return FOLDER / f"{'-'.join(words)}{SUFFIX}"
