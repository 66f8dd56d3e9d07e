"""Many agents of one algorithm that learn together, each as it would alone.

`cohort` has the loop: act, add, sample, update. An algorithm is one file with a subclass of
`algorithm.Algorithm`, and its line in ALGORITHMS; td3.py is the shortest example.
"""

from pkgutil import resolve_name
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from jbrep.rl.cohort.algorithm import Algorithm

ALGORITHMS = {  # classes in this folder by the names of algorithms; DDPG is TD3 with other settings
    "ddpg": "td3.TD3",
    "td3": "td3.TD3",
    "sac": "sac.SAC",
}


def get_algorithm(name: str) -> type["Algorithm"]:
    """The class that trains an algorithm's agents together; importing it takes seconds."""
    return cast("type[Algorithm]", resolve_name(f"{__name__}.{ALGORITHMS[name]}"))
