"""A recording of the features that each unit of a latent moves."""

from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from jbrep.coordinates.nearest import continuous
from jbrep.encoders.base import BaseEncoder
from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Feature
from jbrep.inspection.blueprint import TRAVERSE, traversal_layout
from jbrep.inspection.episode import provenance
from jbrep.inspection.recording import GREY, Recording
from jbrep.inspection.robot import Robot
from jbrep.inspection.scene import WORLD, as_qpos, send_floor
from jbrep.inspection.signals import scaled_titles
from jbrep.jitterbug.tasks import POSITION
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.rollout import Rollout

POINTS = 101
SPACING = 0.12  # [m] between the robots
_ENDS = (1, 99)  # [%] of the episode's latents
_LABEL_HEIGHT = 0.1  # [m]
_MOST = 3  # features that the summary lists for a unit


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

    There is a robot for each unit where the episode has the motion of a Jitterbug.

    Args:
        rollout: the episode whose latents give the range of each unit.
        path: the .rrd file.
        encoder: for the episode's task.
    """
    encoder.check_decodes("--traverse shows what each unit is decoded to")
    task, swept = rollout.task, sweep(encoder.encode(rollout.observation))
    name = f"{encoder.name} on {rollout.name}: each unit of the latent"
    recording = Recording(name, provenance(rollout, encoder), swept)
    times = [rr.TimeColumn(TRAVERSE, sequence=np.arange(POINTS))]
    places, robot, titles = _places(len(swept)), None, scaled_titles(task)
    if rollout.motion and jitterbug_task(task):
        robot = Robot(rollout.motion.model)
        recording.send(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        send_floor(recording, robot, places)
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
        told = (_span(task.features[i], np.ptp(smooth[:, i])) for i in most)
        summary.append(f"| {unit} | {ends} | {', '.join(told)} |")
    recording.send_text(f"{TRAVERSE}/summary", "\n".join(summary))
    recording.write(path, traversal_layout(len(swept), robot, places))


def _places(units: int) -> Array:
    """Positions of the robots in a row, (units, 3)."""
    places = np.zeros((units, 3))
    places[:, 0] = SPACING * (np.arange(units) - (units - 1) / 2)
    return places


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


def _span(feature: Feature, span: float) -> str:
    """How far a unit moves a feature."""
    return f"{feature.name} {span:.3g} {feature.unit}".removesuffix(" 1").rstrip()
