"""Which runs can learn in a cohort."""

import inspect
import json
from collections.abc import Iterator, Mapping
from typing import Any

from jbrep.errors import InputError
from jbrep.rl.names import COHORT, TRAINERS
from jbrep.rl.presets import ALGORITHMS, Preset

_HONOURED = {  # whatever their values
    *("batch_size", "buffer_size", "ent_coef", "gamma", "gradient_steps", "learning_rate"),
    *("learning_starts", "policy_delay", "stats_window_size", "target_entropy"),
    *("target_noise_clip", "target_policy_noise", "target_update_interval", "tau", "train_freq"),
    *("activation_fn", "n_critics"),
}
_EACH_ITS_OWN = ("representation", "encoder", "encoder_code", "encoder_seed", "seed", "from")
_INSTEAD = 'add --trainer sb3, or trainer = "sb3" to a study'


def check(algorithm: str, preset: Preset) -> None:
    """Make sure that runs of an algorithm with these settings can learn in a cohort.

    Raises:
        InputError: they can't; the message says why and names the other trainer.
    """
    if algorithm not in TRAINERS[COHORT]:
        its = ", ".join(TRAINERS[COHORT])
        raise InputError(f"cohorts train {its}, not {algorithm}: {_INSTEAD}")
    if isinstance(preset.settings.get("train_freq"), list):
        raise InputError(f"a cohort takes train_freq as a number of steps: {_INSTEAD}")
    for name, value in _others(algorithm, preset):
        raise InputError(f"a cohort can't learn with {name} = {value}: {_INSTEAD}")


def shared_by(settings: Mapping[str, Any]) -> str:
    """What runs have in common that can learn in one cohort, from the settings of one of them."""
    return json.dumps({n: v for n, v in settings.items() if n not in _EACH_ITS_OWN}, sort_keys=True)


def _others(algorithm: str, preset: Preset) -> Iterator[tuple[str, Any]]:
    """Settings that a cohort doesn't know, unless they are what they are by default."""
    made: Any = ALGORITHMS[algorithm]
    for given, kind in ((preset.settings, made), (preset.policy, made.policy_aliases["MlpPolicy"])):
        usual = inspect.signature(kind).parameters
        for name, value in given.items():
            if name not in _HONOURED and value != usual[name].default:
                yield name, value
