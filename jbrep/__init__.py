"""jbrep: reduced-order representations of an underactuated robot, and what they do to learning.

    jbrep.collect("face_direction", "data/face", steps=100_000)
    jbrep.train_encoder("data/face", "encoders", kind="dae", latent=8)
    jbrep.train("face_direction", "runs/a", encoder="encoders/dae-8.safetensors")

Importing it registers the Jitterbug's environments with Gymnasium; nothing heavy is loaded until
it is used.
"""

from importlib.metadata import version
from types import ModuleType
from typing import TYPE_CHECKING, Any

import wrapt

from jbrep.lazy import exports

if TYPE_CHECKING:
    from jbrep.api import check as check
    from jbrep.api import clone as clone
    from jbrep.api import collect as collect
    from jbrep.api import evaluate as evaluate
    from jbrep.api import evaluate_policy as evaluate_policy
    from jbrep.api import report as report
    from jbrep.api import study as study
    from jbrep.api import train as train
    from jbrep.api import train_encoder as train_encoder
    from jbrep.api import train_encoders as train_encoders
    from jbrep.dataset.reader import Dataset as Dataset
    from jbrep.encoders.encoder import Encoder as Encoder
    from jbrep.encoders.vec_env import JitterbugVecEnv as JitterbugVecEnv
    from jbrep.encoders.wrapper import Encoded as Encoded
    from jbrep.envs.description import describe as describe
    from jbrep.envs.environments import Environments as Environments
    from jbrep.envs.task import Feature as Feature
    from jbrep.envs.task import Task as Task
    from jbrep.rl.controller import load_policy as load_policy
    from jbrep.studies.config import Study as Study

_load, _, __all__ = exports(__name__)


def __getattr__(name: str) -> Any:
    return version(__name__) if name == "__version__" else _load(name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _register(_gymnasium: ModuleType) -> None:
    from jbrep.jitterbug.tasks import register

    register()


wrapt.register_post_import_hook(_register, "gymnasium")
