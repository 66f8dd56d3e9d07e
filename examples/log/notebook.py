# %% [markdown]
# # From a log to a controller
#
# What a robot has logged becomes a data set, the data set a code of the state, the code what an
# agent observes, and the agent one file that runs on the robot. This is a notebook: editors open
# it by its marks, `jupytext --to ipynb notebook.py` makes it one for Jupyter, and `python
# notebook.py` runs it through in some minutes, in a folder that must be new. It needs
# `pip install '.[dm-control,learn,logs,export]'`.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from record import record

import jbrep
from jbrep.dataset import Layout, from_file
from jbrep.rl.controller import export, load_policy
from jbrep.rl.policy_file import find_shipped as find

EPISODES, LIMIT, STEPS = 40, 1000, 150_000
OUT = Path("from-a-log")
OUT.mkdir()
task = jbrep.describe("face_direction", episode_steps=LIMIT)

# %% [markdown]
# ## A log
#
# Take your robot's. Here the Jitterbug stands for it, under a controller that somebody made
# before; `record` writes a line for each step: time, sensors with their units, the motor's
# command and a reward.

# %%
export(load_policy(find(task)), OUT / "earlier.onnx")
earlier = record(str(OUT / "earlier.onnx"), str(OUT / "walk.csv"), EPISODES, LIMIT)
print((OUT / "walk.csv").read_text()[:300])

# %% [markdown]
# ## The data
#
# A layout says which columns are what. The rows are of a robot with an environment, in which an
# agent will learn, so they are given its task; without one the task would be made from the data
# alone. `docs/logs.md` has what can be done about gaps, uneven clocks and missing readings.

# %%
layout = Layout(observations=task.feature_names, time="time", episode="trial")
data = from_file(OUT / "data", OUT / "walk.csv", layout=layout, task=task)
print(data.card())

# %%
for number in range(3):
    episode = data.episode(number)["observation"]
    angle = episode[:, task.feature_names.index("angle_to_target")]
    plt.plot(np.arange(len(angle)) * task.timestep, angle)
plt.xlabel("time [s]")
plt.ylabel("angle to the target [rad]")
plt.savefig(OUT / "angle.png")
plt.close()

# %% [markdown]
# ## A code
#
# Linear prediction takes seconds, here of what stays the same however the world is turned. The
# diagnostics say whether the code keeps what a controller needs; `full` is all that was measured.

# %%
encoder = jbrep.train_encoder(data, OUT / "encoders", "linear-forward", latent=8, on="symmetry")
print(jbrep.evaluate(encoder, data))

# %% [markdown]
# ## An agent
#
# It observes the code alone. It needs the environment: an agent that learns from the log itself
# isn't here. A short run, which tells whether all fits together; a good one has a million steps.

# %%
agent = jbrep.train(task, OUT / "run", encoder=encoder, steps=STEPS, final_episodes=10)
print(agent)

# %% [markdown]
# ## The controller
#
# One model from sensors to motor, with code and scaling inside. `examples/robot` runs such a file
# on a robot in real time; here it plays the episodes that its run was evaluated on.

# %%
export(agent.policy, OUT / "controller.onnx")
alone = jbrep.evaluate_policy(OUT / "controller.onnx", task, episodes=5)
run = jbrep.evaluate_policy(OUT / "run", task, episodes=5)
print(f"the controller returns {np.median(alone):.1f}, its run {np.median(run):.1f} (medians of 5)")
print(f"the log's, which had learned for longer, {np.median(earlier):.1f}")
