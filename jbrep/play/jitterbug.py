"""What an episode of the Jitterbug has beyond those of other robots."""

import mujoco
import numpy as np

from jbrep.envs.lanes import Lanes
from jbrep.envs.physics import Motion
from jbrep.envs.task import Array, Task
from jbrep.errors import InputError
from jbrep.jitterbug.tasks import (
    TASKS,
    JitterbugTask,
    Readings,
    environment_id,
    upright_term,
    yaw_direction,
)


def jitterbug_task(task: Task) -> JitterbugTask | None:
    """The task as the Jitterbug's own; None for another robot's, or if not all of it is seen."""
    if task.view:
        return None
    return next((own for own in TASKS.values() if environment_id(own.name) == task.id), None)


def reward_terms(task: Task, motion: Motion) -> dict[str, Array]:
    """The factors of the reward of each of n states, (n,) each; none for another robot."""
    own = jitterbug_task(task)
    if own is None:
        return {}
    readings = read(motion)
    terms = (upright_term, *own.terms)
    return {term.__name__.removesuffix("_term"): term(readings) for term in terms}


def read(motion: Motion) -> Readings:
    """What the Jitterbug's tasks read of n states."""
    data, body = mujoco.MjData(motion.model), motion.model.body("jitterbug").id
    rotation, velocity = np.empty((len(motion), 9)), np.empty((len(motion), 3))
    for state in range(len(motion)):
        motion.put(data, state)
        mujoco.mj_fwdPosition(motion.model, data)
        mujoco.mj_fwdVelocity(motion.model, data)
        mujoco.mj_sensorVel(motion.model, data)
        rotation[state], velocity[state] = data.xmat[body], data.sensordata
    return Readings(
        motion.qpos,
        motion.qvel,
        rotation,
        velocity,
        motion.arrays["mocap_pos"][:, 0],
        yaw_direction(motion.arrays["mocap_quat"][:, 0]),
    )


def turn_targets(lanes: Lanes, yaw: float) -> None:
    """Turn the target of every lane to that yaw [rad], at the start of its episode."""
    if jitterbug_task(lanes.task) is None:
        raise InputError(f"{lanes.task.name} has no target to turn: only the Jitterbug's tasks do")
    if lanes.task.domain:
        raise InputError(
            f"{lanes.task.name} draws its {lanes.task.domain} in each episode, in which no target "
            f"is turned: add --task {lanes.task.name} to play it as it is"
        )
    simulation = lanes.envs.simulation
    turned = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    targets = {"target_quaternion": np.tile(turned, (lanes.num_lanes, 1))}
    simulation.restore(**simulation.state | targets)
    lanes.observation = lanes.envs.look()
