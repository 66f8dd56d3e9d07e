"""A recording of an episode, with an encoder's reconstruction of it."""

from importlib.metadata import version
from pathlib import Path

import numpy as np

from jbrep.encoders.base import BaseEncoder
from jbrep.inspection.blueprint import episode_layout, series_pages
from jbrep.inspection.directions import name_directions, send_directions
from jbrep.inspection.fan import fan_pages, make_fan, send_fan
from jbrep.inspection.forecast import Examples, decode
from jbrep.inspection.recording import Recording
from jbrep.inspection.robot import Robot
from jbrep.inspection.scene import send_ghost, send_scene
from jbrep.inspection.signals import send_encoding, send_signals, send_terms, times_at
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.rollout import Rollout


def record_episode(
    rollout: Rollout,
    path: Path,
    encoder: BaseEncoder | None = None,
    examples: Examples | None = None,
) -> None:
    """Write an episode's recording.

    Args:
        rollout: the episode.
        path: the .rrd file.
        encoder: for the episode's task; its latent is shown with what it predicts, and its
            reconstruction if it decodes.
        examples: what forecasts and directions are fitted to; the episode itself if not given.
    """
    task, motion = rollout.task, rollout.motion
    content = [rollout.observation, rollout.action, rollout.reward]
    if motion:
        content.append(motion.qpos)
    if examples is None:
        examples = Examples([rollout.observation], [rollout.action], "this same episode")
    fan = make_fan(rollout, encoder, examples) if encoder else None
    about = provenance(rollout, encoder, fan.about if fan else "")
    recording = Recording(rollout.name, about, *content)
    times = times_at(task, np.arange(len(rollout) + 1))
    robot, pages = Robot(motion.model) if motion else None, []
    send_signals(recording, rollout)
    if robot and motion:
        send_scene(recording, robot, times, motion)
        send_terms(recording, task, motion)
    if encoder:
        latent = encoder.encode(rollout.observation)
        seen = rollout.observation
        decoded = decode(encoder, task, latent, seen) if encoder.can_decode else None
        send_encoding(recording, times, rollout, encoder, latent, decoded)
        if decoded is not None and robot and motion and jitterbug_task(task):
            send_ghost(recording, robot, times, task, motion, decoded)
        if fan:
            send_fan(recording, rollout, fan, robot)
            pages += fan_pages(task, fan)
        if directions := name_directions(encoder, task, examples):
            send_directions(recording, times, latent.astype(np.float64), directions)
            plots = {label: [path] for label, path in directions.paths.items()}
            pages += series_pages("slow and fast directions", task, plots)
    recording.write(path, episode_layout(task, robot, encoder, pages))


def provenance(rollout: Rollout, encoder: BaseEncoder | None, more: str = "") -> str:
    """The origin of an episode and its encoder as Markdown, and more of it below."""
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
    lines = [f"# {rollout.name}", "", *(f"- {name}: {fact}" for name, fact in facts.items())]
    return "\n".join([*lines, *(("", more) if more else ())])
