"""Run an exported policy on a robot, with NumPy and onnxruntime alone.

    python controller.py controller.onnx --port 9000

The robot sends a UDP datagram at each control step: a number that counts them (uint32) and its
sensors (float32 each, in the order and units of the model's metadata, less its offsets). The answer
is that number and the action. What can go wrong: no datagram for three periods, an old one, one of
another size, a sensor that says NaN or something far outside its range. The answer is then the safe
action, and after a second of that the controller stops.
"""

import argparse
import json
import socket
import struct
import time
from collections import deque

import numpy as np
import onnxruntime

PATIENCE = 3  # control periods without a datagram
FAR = 10.0  # usual ranges beyond which a sensor is not believed
GIVE_UP = 1.0  # seconds of safe actions


class Controller:
    """A policy's model, with what its metadata say."""

    def __init__(self, path: str):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = onnxruntime.InferenceSession(path, options)
        said = json.loads(self._session.get_modelmeta().custom_metadata_map["jbrep"])
        low, high = (
            np.array([np.nan if f[end] is None else f[end] for f in said["observation"]])
            for end in ("low", "high")
        )
        room = FAR * (high - low)
        self._low, self._high = low - room, high + room  # NaN where no range is known
        self.size, self.repeat, self.chunk = len(low), said["action_repeat"], said["chunk"]
        self._states: deque[np.ndarray] = deque(maxlen=said["history"])  # the newest first
        self._actions: deque[np.ndarray] = deque(maxlen=said["history"] - 1)
        self.period = said["control_period"] or 0.01
        bounds = np.array([said["action"]["low"], said["action"]["high"]], np.float32)
        self.safe = np.clip(np.zeros_like(bounds[0]), *bounds)  # no torque
        self.seconds: list[float] = []  # that each action took
        self._action, self._chosen = self.safe, -1  # the newest, and the chunk it is of

    def act(self, step: int, sensors: np.ndarray) -> np.ndarray | None:
        """The action at a control step; None, for the safe one, if sensors can't be believed.

        The history then has the sensors of the step before once more.
        """
        if step == 0:  # another episode
            self._states.clear()
            self._chosen = -1
        if not np.isfinite(sensors).all() or ((sensors < self._low) | (sensors > self._high)).any():
            if self._states:
                self._states.appendleft(self._states[0])
                self._actions.appendleft(self.safe)
            return None
        if not self._states:  # before the start it stood still
            self._states.extend([sensors] * (self._states.maxlen or 1))
            self._actions.extend([self.safe] * (self._actions.maxlen or 0))
        self._states.appendleft(sensors)
        number = step // self.repeat
        if number // self.chunk != self._chosen:
            self._chosen = number // self.chunk
            began = time.perf_counter()
            seen = np.concatenate([*self._states, *self._actions])[None]
            (actions,) = self._session.run(["action"], {"observation": seen})
            self.seconds.append(time.perf_counter() - began)
            self._ahead = actions[0].reshape(self.chunk, -1)
        self._action = self._ahead[number % self.chunk]
        self._actions.appendleft(self._action)
        return self._action


def listen(port: int) -> socket.socket:
    """Where the robot's datagrams arrive."""
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.bind(("127.0.0.1", port))
    return link


def serve(controller: Controller, link: socket.socket, steps: int | None) -> int:
    """Answer a robot's datagrams; the number of answers that were the safe action."""
    link.settimeout(None)  # the robot begins
    robot, newest, safe, in_a_row = None, -1, 0, 0
    while steps is None or newest + 1 < steps:  # the watchdog is the timeout
        try:
            datagram, robot = link.recvfrom(65536)
            link.settimeout(PATIENCE * controller.period)
            action = None
            if len(datagram) == 4 + 4 * controller.size:
                (step,) = struct.unpack_from("<I", datagram)
                if 0 < step <= newest:
                    continue  # an old one, overtaken on its way; at 0 the robot begins again
                newest = step
                action = controller.act(step, np.frombuffer(datagram, np.float32, offset=4))
        except TimeoutError:
            action = None
        in_a_row = in_a_row + 1 if action is None else 0
        safe += action is None
        answer = controller.safe if action is None else action
        link.sendto(struct.pack("<I", max(newest, 0)) + answer.tobytes(), robot)
        if in_a_row * controller.period > GIVE_UP:
            break
    return safe


def main() -> None:
    """Serve one robot, and say how fast."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("model")
    parser.add_argument("--port", type=int, default=9000)
    parser.add_argument("--steps", type=int, help="to stop after; without end if not given")
    given = parser.parse_args()
    controller = Controller(given.model)
    with listen(given.port) as link:
        safe = serve(controller, link, given.steps)
    half, most, worst = 1e6 * np.percentile(controller.seconds, (50, 99, 100))
    print(
        f"{len(controller.seconds):,} actions, {safe} times the safe one; "
        f"computed in {half:.0f} us (50 %), {most:.0f} us (99 %), {worst:.0f} us (all)"
    )


if __name__ == "__main__":
    main()
