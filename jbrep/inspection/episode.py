"""A recording of an episode, with an encoder's reconstruction of it."""

from importlib.metadata import version
from pathlib import Path

import numpy as np

from jbrep.encoders import Encoder
from jbrep.encoders.file import fingerprint
from jbrep.inspection.blueprint import episode_layout
from jbrep.inspection.ghost import Ghost, send_ghost
from jbrep.inspection.latent import send_encoding
from jbrep.inspection.recording import Recording
from jbrep.inspection.robot import Robot
from jbrep.inspection.scene import send_scene
from jbrep.inspection.signals import send_signals, times_at
from jbrep.rollouts.rollout import Rollout


def record_episode(rollout: Rollout, path: Path, encoder: Encoder | None = None) -> None:
    """Write an episode's recording.

    Args:
        rollout: the episode.
        path: the .rrd file.
        encoder: for the episode's task; its reconstruction is shown beside the episode.

    Raises:
        InputError: the file can't be written.
    """
    about = provenance(rollout, encoder)
    recording = Recording(rollout.name, about, rollout.qpos, rollout.action)
    robot, times = Robot(), times_at(np.arange(len(rollout) + 1))
    send_scene(recording, robot, times, rollout)
    send_signals(recording, rollout)
    if encoder:
        ghost = Ghost.of(
            encoder, rollout.task, encoder.encode(rollout.observation.astype(np.float32))
        )
        send_ghost(recording, robot, times, rollout, ghost)
        send_encoding(recording, times, rollout, encoder, ghost)
    recording.write(path, episode_layout(rollout.task, encoder))


def provenance(rollout: Rollout, encoder: Encoder | None) -> str:
    """The origin of an episode and its encoder, as Markdown."""
    facts = {
        "task": rollout.task.name,
        "seed": f"{rollout.seed}",
        "steps": f"{len(rollout):,}",
        "return": f"{rollout.reward.sum():.1f}",
    }
    if encoder:
        facts |= {
            "encoder": f"{encoder.name} ({encoder.header['kind']})",
            "sizes": f"{encoder.size} features, {encoder.latent_size} units",
            "SHA-256": f"`{fingerprint(encoder)}`",
        }
    facts |= {package: version(package) for package in ("jbrep", "mujoco")}
    return "\n".join(
        [f"# {rollout.name}", "", *(f"- {name}: {fact}" for name, fact in facts.items())]
    )
