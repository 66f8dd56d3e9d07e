"""A stand-in for a robot: a task of jbrep that sends its sensors by UDP and takes actions.

    python robot.py face_direction --port 9000 --in-step

It keeps the task's rate: each step takes the newest action that has come, and counts as late where
that answers an earlier step. --in-step waits for each answer instead, so that an episode is the one
that the run itself would play.
"""

import argparse
import socket
import struct
import time

import numpy as np

import jbrep
from jbrep.rl.files import EVALUATION_SEED

_PATIENCE = 5.0  # seconds to wait for an answer, in step


def play(task: str, port: int, episode: int, steps: int | None, in_step: bool) -> float:
    """Play an episode of evaluation; its return."""
    described = jbrep.describe(task, episode_steps=steps)
    envs, total, late = jbrep.Environments(described, 1), 0.0, 0
    observation = envs.reset([0], [EVALUATION_SEED + episode])[0]
    action = np.zeros(described.action_size, np.float32)
    period = described.timestep or 0.01
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        due = time.monotonic()
        for step in range(described.max_episode_steps):
            link.send(struct.pack("<I", step) + observation.astype(np.float32).tobytes())
            due += period
            until = time.monotonic() + _PATIENCE if in_step else due
            action, is_late = _newest(link, step, until, action)
            late += is_late
            taken = envs.step(action[None])
            total += float(taken.reward[0])
            observation = taken.observation[0]
            if not in_step:
                time.sleep(max(0.0, due - time.monotonic()))
    print(f"{described.name}: return {total:.1f}, {late} actions late")
    return total


def _newest(
    link: socket.socket, step: int, until: float, action: np.ndarray
) -> tuple[np.ndarray, bool]:
    """The answer to a step, or the newest action until then, and whether it is late."""
    while True:
        link.settimeout(max(until - time.monotonic(), 1e-6))
        try:
            answer = link.recv(65536)
        except TimeoutError:
            return action, True
        action = np.frombuffer(answer, np.float32, offset=4)
        if struct.unpack_from("<I", answer)[0] == step:
            return action, False


def main() -> None:
    """Play an episode."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("--port", type=int, default=9000)
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--steps", type=int, help="of the episode, if fewer than the task's")
    parser.add_argument("--in-step", action="store_true")
    given = parser.parse_args()
    try:
        play(given.task, given.port, given.episode, given.steps, given.in_step)
    except ConnectionRefusedError:
        raise SystemExit(f"no controller answers at port {given.port}: start it first") from None


if __name__ == "__main__":
    main()
