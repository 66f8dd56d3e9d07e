# %% [markdown]
# # From a log to a controller
#
# What a robot has logged becomes a data set, the data set a code of the state and a policy that
# does what was done, and the policy one file that runs on the robot. No simulator is needed. This
# is a notebook: editors open it by its marks, `jupytext --to ipynb notebook.py` makes it one for
# Jupyter, and `python notebook.py` runs it through in some minutes, in a folder that must be new.
# It needs `pip install '.[dm-control,learn,logs,export]'`.

# %%
import json
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np
import onnxruntime
from record import record

import jbrep
from jbrep.dataset import Layout, from_file
from jbrep.rl.controller import export, load_policy
from jbrep.rl.policy_file import find_shipped as find

EPISODES, LIMIT, STEPS = 40, 1000, 20_000
OUT = Path("from-a-log")
OUT.mkdir()

# %% [markdown]
# ## A log
#
# Take your robot's. Here the Jitterbug stands for it, under a controller that somebody made
# before; `record` writes a line for each step: time, sensors with their units, the motor's
# command and a reward.

# %%
robot = jbrep.describe("face_direction", episode_steps=LIMIT)
export(load_policy(find(robot)), OUT / "earlier.onnx")
earlier = record(str(OUT / "earlier.onnx"), str(OUT / "walk.csv"), EPISODES, LIMIT)
print((OUT / "walk.csv").read_text()[:300])

# %% [markdown]
# ## The data
#
# A layout says which columns are what; from here on nothing but the log is known. Look at the
# ranges, units and lengths of episodes before anything is learned. `docs/logs.md` has what can be
# done about gaps, uneven clocks and missing readings.

# %%
layout = Layout(
    observations=robot.feature_names,
    actions=("action_0",),
    reward="reward",
    time="time",
    episode="trial",
    angles=("angle_to_target",),
)
data = from_file(OUT / "data", OUT / "walk.csv", layout=layout)
print(data.card())

# %%
for number in range(3):
    episode = data.episode(number)
    plt.plot(np.arange(len(episode)) * data.task.timestep, episode["angle_to_target"])
plt.xlabel("time [s]")
plt.ylabel("angle to the target [rad]")
plt.savefig(OUT / "angle.png")
plt.close()

# %% [markdown]
# ## An encoder
#
# Linear prediction takes seconds, here of coordinates without jumps. The diagnostics say what the
# code keeps; `full` is all that was measured.

# %%
encoder = jbrep.train_encoder(data, OUT / "encoders", "linear-forward", latent=8, on="coordinates")
print(jbrep.evaluate(encoder, data))

# %% [markdown]
# ## A policy
#
# Behaviour cloning: from the code, the action that was logged. With rewards, as here,
# `method="td3+bc"` learns to do better than a log that is partly bad; this one is good. The errors
# are of episodes that were held out.

# %%
agent = jbrep.clone(data, OUT / "clone", encoder=encoder, steps=STEPS)
print(agent.clone.card(80))

# %% [markdown]
# **What isn't known without a simulator**: what the policy returns. The error is that in states of
# the log. A policy that errs a little comes to states that aren't in the log, where it errs more:
# its return can be low though its error is. It has seen no fall and no recovery that its teacher
# never had. So first let it run beside the old controller without driving, and compare their
# actions; then drive slowly, with a watchdog and a hand on the switch.
#
# ## The controller
#
# One model from sensors to motor, with code and scaling inside; onnxruntime and NumPy run it.
# `examples/robot` does so in real time, with a watchdog. The loop below is all that is needed; the
# Jitterbug, which the policy has never met, shows here what a robot would show.

# %%
export(agent.policy, OUT / "controller.onnx")
session = onnxruntime.InferenceSession(str(OUT / "controller.onnx"))
said = json.loads(session.get_modelmeta().custom_metadata_map["jbrep"])
sensors = [each["name"] for each in said["observation"]]
print(f"{len(sensors)} sensors, such as {sensors[0]}; an action every {said['control_period']} s")
environment, returns = gymnasium.make(robot.id, max_episode_steps=LIMIT), []
for seed in range(5):
    seen, _ = environment.reset(seed=seed)
    returns.append(0.0)
    is_over = False
    while not is_over:
        if not np.isfinite(seen).all():
            break  # of a robot: stop the motor
        (action,) = session.run(["action"], {"observation": np.float32(seen)[None]})
        seen, reward, terminated, truncated, _ = environment.step(action[0])
        returns[-1] += float(reward)
        is_over = terminated or truncated
environment.close()
print(f"the clone returns {np.median(returns):.1f}, what it learned from {np.median(earlier):.1f}")
