"""Recordings of what a user names: an episode with its reconstruction, or a latent's units."""

import re
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.coordinates.placing import continuous, placed
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import find
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import SUFFIX as ENCODER_SUFFIX
from jbrep.encoders.shipped import find_alone, source_of
from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.inspection.blueprint import TRAVERSE, episode_layout, traversal_layout
from jbrep.inspection.recording import GREY, SUFFIX, Recording, check_out
from jbrep.inspection.robot import Robot
from jbrep.inspection.scene import WORLD, as_qpos, send_ghost, send_scene
from jbrep.inspection.signals import scaled_titles, send_encoding, send_signals, times_at
from jbrep.jitterbug.tasks import POSITION, jitterbug_task
from jbrep.play.rollout import Rollout
from jbrep.play.sources import find_episode, is_trained, run_folder
from jbrep.records.storage import exists
from jbrep.rl.files import ENCODER, check_begun, is_run

FOLDER = Path("inspect")  # of recordings without an --out
_POLICY = "uniform"  # plays the episode that an encoder alone is shown on
POINTS = 101
SPACING = 0.12  # [m] between the robots
_ENDS = (1, 99)  # [%] of the episode's latents
_LABEL_HEIGHT = 0.1  # [m]
_MOST = 3  # features that the summary lists for a unit


def inspect(
    source: str | None = None,
    episode: int | None = None,
    task: Task | None = None,
    encoder: Any = None,
    traverse: bool = False,
    out: Path | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> Path:
    """Write the Rerun recording of an episode, or of a latent's units.

    Parameters are those of the command; an encoder may also be an object that encodes, and `tell`
    is called with lines on where it is from and on a robot that can't be shown.

    Returns:
        The .rrd file.
    """
    if out:
        check_out(out)
    rollout, shown = _find(source, episode or 0, task, encoder)
    if isinstance(encoder, (str, Path)):
        tell(f"encoder: {source_of(encoder, rollout.task)}")
    if rollout.note:
        tell(rollout.note)
    if traverse and not shown:
        raise InputError("--traverse moves the units of a latent: give an `encoder`")
    if out is None:
        more = [*([shown.name] if shown else []), *(["traverse"] if traverse else [])]
        out = _default(source, rollout.task.slug, f"episode-{episode or 0}", *more)
    if shown and traverse:
        record_traversal(rollout, out, shown)
    else:
        record_episode(rollout, out, shown)
    return out


def _find(
    source: str | None, episode: int, task: Task | None, encoder: Any
) -> tuple[Rollout, BaseEncoder | None]:
    if source is None or (source.endswith(ENCODER_SUFFIX) and not is_trained(source)):
        if (source is None) == (encoder is None):
            raise InputError("give a SOURCE to inspect, or one encoder with its `task`")
        shown = find_alone(encoder if source is None else source, task)
        shown.check_task(task or shown.task)
        return find_episode(_POLICY, episode, task or shown.task), shown
    path = Path(source)
    if exists(path) and path.is_dir() and not exists(path / MANIFEST) and not is_run(path):
        check_begun(path)
        raise InputError(
            f"{source} is no data set, and no run with a policy or checkpoint: give the folder of "
            "one; jbrep report shows the curves of several runs"
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


def record_episode(rollout: Rollout, path: Path, encoder: BaseEncoder | None = None) -> None:
    """Write an episode's recording, with an encoder's latent, and what it decodes if it does."""
    task, motion = rollout.task, rollout.motion
    content = [rollout.observation, rollout.action, rollout.reward]
    if motion:
        content.append(motion.qpos)
    recording = Recording(rollout.name, provenance(rollout, encoder), *content)
    times = times_at(task, np.arange(len(rollout) + 1))
    robot = Robot(motion.model) if motion else None
    send_signals(recording, rollout)
    if robot and motion:
        send_scene(recording, robot, times, motion)
    if encoder:
        latent, decoded = encoder.encode(rollout.observation), None
        if encoder.can_decode:
            back = encoder.decode(latent).astype(np.float64)
            decoded = placed(task, back, rollout.observation) if encoder.not_decoded else back
        send_encoding(recording, times, rollout, encoder, latent, decoded)
        if decoded is not None and robot and motion and jitterbug_task(task):
            send_ghost(recording, robot, times, task, motion, decoded)
    recording.write(path, episode_layout(task, robot, encoder))


def provenance(rollout: Rollout, encoder: BaseEncoder | None) -> str:
    """The origin of an episode and its encoder as Markdown."""
    facts = {"task": rollout.task.name}
    if rollout.task.arguments:
        facts["arguments"] = f"`{', '.join(rollout.task.given_arguments)}`"
    if rollout.task.domain:
        facts["domain"] = f"`{rollout.task.domain}`"
    if rollout.seed >= 0:  # or else it isn't known
        facts["seed"] = f"{rollout.seed}"
    facts["steps"] = f"{len(rollout):,}"
    if np.isfinite(rollout.reward).all():
        facts["return"] = f"{rollout.episode_return:.1f}"
    facts["end"] = "terminated" if rollout.terminated else "truncated"
    if rollout.note:
        facts["note"] = rollout.note
    if encoder:
        facts |= {
            "encoder": f"{encoder.name} ({encoder.kind})",
            "sizes": f"{encoder.size} features, {encoder.latent_size} units",
            "SHA-256": f"`{encoder.fingerprint}`",
        }
    facts |= {package: version(package) for package in ("jbrep", "mujoco")}
    lines = (f"- {name}: {fact}" for name, fact in facts.items())
    return "\n".join([f"# {rollout.name}", "", *lines])


def sweep(latent: NDArray[np.float32]) -> NDArray[np.float32]:
    """Latents (l, 101, l) that vary one unit at a time, with the others at their medians.

    The range of each unit is that of the latents (n, l), from their 1st to their 99th percentile.
    """
    low, high = np.percentile(latent, _ENDS, axis=0)
    units = latent.shape[1]
    swept = np.tile(np.median(latent, axis=0), (units, POINTS, 1))
    swept[range(units), :, range(units)] = np.linspace(low, high, POINTS, axis=1)
    return swept.astype(np.float32)


def record_traversal(rollout: Rollout, path: Path, encoder: BaseEncoder) -> None:
    """Write a recording of what is decoded while one unit after the other varies.

    The episode's latents give the range of each unit; of a Jitterbug there is a robot for each.
    """
    encoder.check_decodes("--traverse shows what each unit is decoded to")
    task, swept = rollout.task, sweep(encoder.encode(rollout.observation))
    name = f"{encoder.name} on {rollout.name}: each unit of the latent"
    recording = Recording(name, provenance(rollout, encoder), swept)
    times = [rr.TimeColumn(TRAVERSE, sequence=np.arange(POINTS))]
    robot, titles, places = None, scaled_titles(task), np.zeros((len(swept), 3))
    places[:, 0] = SPACING * (np.arange(len(swept)) - (len(swept) - 1) / 2)  # in a row
    if rollout.motion and jitterbug_task(task):
        robot = Robot(rollout.motion.model)
        recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    summary = ["| unit | from | to | moves most |", "|---|---|---|---|"]
    for unit, (latent, place) in enumerate(zip(swept, places, strict=True)):
        decoded, below = encoder.decode(latent).astype(np.float64), f"{TRAVERSE}/unit_{unit}"
        if robot:
            _send_robot(recording, robot, times, as_qpos(task, decoded), unit, place)
        smooth = continuous(task, decoded)
        scaled = encoder.scale(smooth)
        most = np.argsort(-np.ptp(scaled, axis=0))[:_MOST]
        recording.send_series(f"{below}/decoded", times, scaled, titles)
        recording.send_series(f"{below}/most", times, scaled[:, most], [titles[i] for i in most])
        ends = f"{latent[0, unit]:.2f} | {latent[-1, unit]:.2f}"
        spans = [(task.features[i], np.ptp(smooth[:, i])) for i in most]
        spans_text = ", ".join(
            f"{f.name} {span:.3g} {f.unit}".removesuffix(" 1") for f, span in spans
        )
        summary.append(f"| {unit} | {ends} | {spans_text} |")
    recording.send_text(f"{TRAVERSE}/summary", "\n".join(summary))
    recording.write(path, traversal_layout(len(swept), robot, places))


def _send_robot(
    recording: Recording,
    robot: Robot,
    times: list[rr.TimeColumn],
    qpos: Array,
    unit: int,
    place: Array,
) -> None:
    """Send a unit's robot and label; decoded x and y are left out, to keep it in the row."""
    here, path = qpos.copy(), f"{WORLD}/unit_{unit}"
    here[:, POSITION.start : POSITION.start + 2] = place[:2]
    poses = robot.poses(Motion(robot.model, {"qpos": here}))
    robot.draw(recording, path, times, poses, robot.bodies)
    above, text = [(*place[:2], _LABEL_HEIGHT)], [f"unit {unit}"]
    label = rr.Points3D(above, labels=text, colors=[GREY], radii=[0.0], show_labels=True)
    recording.send(f"{path}/label", label)
