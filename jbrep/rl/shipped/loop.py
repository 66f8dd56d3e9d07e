"""A control loop on a policy's ONNX file, with NumPy and onnxruntime alone.

    python controller_loop.py controller.onnx

Put your robot in the place of `Robot`.
"""

import json
import sys
import time

import numpy as np
import onnxruntime

FAR = 10.0  # usual ranges beyond which a sensor isn't believed
MOST_HELD = 3  # control steps in a row without sensors to believe, before the robot is stopped


class Policy:
    """An exported policy, with the history and the held action that its model lacks."""

    def __init__(self, path: str):
        self._model = onnxruntime.InferenceSession(path)
        said = json.loads(self._model.get_modelmeta().custom_metadata_map["jbrep"])
        features, bounds = said["observation"], said["action"]
        self.names = [each["name"] for each in features]
        self.period, self._repeat = said["control_period"], said["action_repeat"]
        if not self.period:
            raise SystemExit("the policy's task has no time step: set `period` here [s]")
        self._chunk = np.zeros((said["chunk"], len(bounds["low"])))  # actions chosen at once
        low, high = (np.array([f[end] for f in features], float) for end in ("low", "high"))
        self._low, self._high = low - FAR * (high - low), high + FAR * (high - low)
        self._offset = np.array([each["offset"] for each in features])
        self.rest = np.clip(np.zeros(len(bounds["low"])), bounds["low"], bounds["high"])
        self._states: list[np.ndarray] = []  # the newest first, then so the actions between
        self._actions = [self.rest] * (said["history"] - 1)
        self._count, self._action = said["history"], self.rest
        self._step, self._choice, self.held = -1, -1, 0

    def __call__(self, sensors: np.ndarray | None, step: int) -> np.ndarray | None:
        """The action at a control step; None once the sensors were missing for too long."""
        given = np.full(len(self.names), np.nan) if sensors is None else np.asarray(sensors, float)
        if given.shape != (len(self.names),):
            raise ValueError(f"{given.shape} sensors: they must be {', '.join(self.names)}")
        given = given - self._offset
        bad = not np.isfinite(given).all() or ((given < self._low) | (given > self._high)).any()
        skipped, self._step = step - self._step - 1 if self._states else 0, step
        self.held = self.held + skipped + 1 if bad else 0
        if max(self.held, skipped) > MOST_HELD or (bad and not self._states):
            return None
        for now in [*self._states[:1] * skipped, self._states[0] if bad else given]:
            if self._states:
                self._actions = [self._action, *self._actions][: self._count - 1]
            self._states = [now, *(self._states or [now] * self._count)][: self._count]
        choice, part = divmod(step // self._repeat, len(self._chunk))
        if choice != self._choice:
            self._choice = choice
            seen = np.concatenate([*self._states, *self._actions])[None].astype(np.float32)
            chosen = self._model.run(["action"], {"observation": seen})[0]
            self._chunk = chosen.reshape(self._chunk.shape)
        self._action = self._chunk[part]
        return self._action


class Robot:
    """Yours."""

    def read(self) -> np.ndarray | None:
        """The sensors that `policy.names` lists, in its units; None where they are late."""
        return np.zeros(len(policy.names))

    def act(self, action: np.ndarray) -> None:
        """Send an action to the actuators."""


if __name__ == "__main__":
    policy, robot = Policy(sys.argv[1]), Robot()
    begin = time.monotonic()
    for _ in range(int(sys.argv[2]) if len(sys.argv) > 2 else sys.maxsize):
        step = int((time.monotonic() - begin) / policy.period)  # those that were late are left out
        action = policy(robot.read(), step)
        robot.act(policy.rest if action is None else action)
        if action is None:
            raise SystemExit(f"stopped at step {step}: sensors were missing {policy.held} times")
        time.sleep(max(0.0, begin + (step + 1) * policy.period - time.monotonic()))
