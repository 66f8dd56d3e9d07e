"""A stand-in for a robot: a task of jbrep that sends its sensors by UDP and takes actions.

    python robot.py face_direction --port 9000 --in-step

It keeps the task's rate, holding the last action where none came in time; --in-step waits for each
answer instead, so that an episode is the one that the run itself would play.
"""

import argparse
import socket
import struct
import time

import numpy as np

import jbrep
from jbrep.rl.files import EVALUATION_SEED


def play(task: str, port: int, episode: int, steps: int | None, in_step: bool) -> float:
    """Play an episode of evaluation; its return."""
    described = jbrep.describe(task, max_episode_steps=steps)
    lanes, total, late = jbrep.Lanes(described, 1), 0.0, 0
    observation = lanes.reset([0], [EVALUATION_SEED + episode])[0]
    action = np.zeros(described.action_size, np.float32)
    period = described.timestep or 0.01
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        link.settimeout(5.0 if in_step else period)
        due = time.monotonic()
        for step in range(described.max_episode_steps):
            link.send(struct.pack("<I", step) + observation.astype(np.float32).tobytes())
            due += period
            try:
                action = _answer(link, step if in_step else None)
            except TimeoutError:
                late += 1
            taken = lanes.step(action[None])
            total += float(taken.reward[0])
            observation = taken.observation[0]
            if not in_step:
                time.sleep(max(0.0, due - time.monotonic()))
    print(f"{described.name}: return {total:.1f}, {late} actions late")
    return total


def _answer(link: socket.socket, step: int | None) -> np.ndarray:
    """The next action that comes; with a step, the next one that answers that step."""
    while True:
        answer = link.recv(65536)
        if step is None or struct.unpack_from("<I", answer)[0] == step:
            return np.frombuffer(answer, np.float32, offset=4)


def main() -> None:
    """Play an episode."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task")
    parser.add_argument("--port", type=int, default=9000)
    parser.add_argument("--episode", type=int, default=0)
    parser.add_argument("--steps", type=int, help="of the episode, if fewer than the task's")
    parser.add_argument("--in-step", action="store_true")
    given = parser.parse_args()
    play(given.task, given.port, given.episode, given.steps, given.in_step)


if __name__ == "__main__":
    main()
