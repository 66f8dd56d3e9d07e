"""Let an exported policy drive a robot alone, and log what its sensors and its motor say.

    python record.py controller.onnx --episodes 100 --out walk.csv

The robot is the environment that the model names; the policy needs onnxruntime and nothing of
jbrep. A row of the log has what was observed, the action that followed and the reward of that; the
last row of an episode has only what was observed after the last action. An episode ends early where
the environment ends it.
"""

import argparse
import csv
import json
from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime

import jbrep

FIRST_SEED = 1 << 32  # of episodes, as jbrep collect --seed 0 has them


def record(model: str, out: str, episodes: int = 100, steps: int = 1000) -> list[float]:
    """Write the log of some episodes; their returns."""
    session = onnxruntime.InferenceSession(model)
    said = json.loads(session.get_modelmeta().custom_metadata_map["jbrep"])
    arguments = said["environment"].get("arguments", {})
    task = jbrep.describe(said["task"], arguments)
    period, repeat = said["control_period"], said["action_repeat"]
    if not period or said["history"] > 1 or said["chunk"] > 1:
        raise SystemExit(f"{model} must act on single states, in steps of a known time")
    offset = np.array([each["offset"] for each in said["observation"]])
    sensors = [f"{each['name']} [{each['unit']}]" for each in said["observation"]]
    motors = [f"action_{i}" for i in range(len(said["action"]["low"]))]
    environment, returns = gymnasium.make(task.id, max_episode_steps=steps, **arguments), []
    with Path(out).open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["trial", "time [s]", *sensors, *motors, "reward"])
        for trial in range(episodes):
            seen, _ = environment.reset(seed=FIRST_SEED + trial)
            returns.append(0.0)
            for step in range(steps):
                if step % repeat == 0:
                    given = {"observation": np.float32(seen - offset)[None]}
                    action = session.run(["action"], given)[0][0]
                before = seen
                seen, reward, is_over, *_ = environment.step(action)
                log.writerow([trial, round(step * period, 6), *before, *action, np.float32(reward)])
                returns[-1] += float(reward)
                if is_over:
                    break
            log.writerow([trial, round((step + 1) * period, 6), *seen, *action, 0])
    environment.close()
    return returns


def main() -> None:
    """Record, and say what the episodes returned."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("model")
    parser.add_argument("--out", required=True, help="a CSV file")
    parser.add_argument("--episodes", type=int, default=100)
    given = parser.parse_args()
    returns = record(given.model, given.out, given.episodes)
    least, half, most = np.percentile(returns, (10, 50, 90))
    print(f"{given.out}: {len(returns)} episodes, median {half:.1f} [{least:.1f}, {most:.1f}]")


if __name__ == "__main__":
    main()
