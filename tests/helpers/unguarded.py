"""A script without a main guard, whose first environment stands in it."""

import sys
from pathlib import Path

import environments
import gymnasium

from jbrep.collecting import collect
from jbrep.dataset import DataSettings
from jbrep.envs import describe


class Here(environments.Sledge):
    """A sledge of this script."""


gymnasium.register("Scripts/Here-v0", entry_point=Here, max_episode_steps=30)
gymnasium.register("Scripts/There-v0", entry_point="environments:Sledge", max_episode_steps=30)
for name in ("Here", "There"):
    settings = DataSettings(task=describe(f"Scripts/{name}-v0"), steps=200, shard_episodes=4)
    print(collect(settings, Path(sys.argv[1]) / name, num_threads=2).rows)
