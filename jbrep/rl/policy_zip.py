"""policy.zip, for stable-baselines3 and other programs: equal runs have equal bytes."""

import io
import json
import zipfile
from typing import Any

import safetensors.numpy
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import data_to_json

from jbrep.rl.agent import statistics_of

STATISTICS = "observation_statistics.safetensors"  # by which an agent normalises what it sees
_OF_TRAINING = {
    "action_noise",  # which may be jbrep's own
    "replay_buffer_class",  # `load` finds the one for n_steps, and warns of one that is given
}
_OF_THIS_PROCESS = {  # wall times, and where the environment was: `load` starts with defaults
    "_last_episode_starts",
    "_current_progress_remaining",
    "_last_obs",
    "_last_original_obs",
    "_num_timesteps_at_start",
    "ep_info_buffer",
    "ep_success_buffer",
    "start_time",
}


def policy_zip(agent: BaseAlgorithm) -> bytes:
    """A zip file that the algorithm's `load` takes, as its `save` writes it.

    Unlike there, members carry a fixed date, whatever the clock says, and nothing in them depends
    on the process or the machine. Statistics by which the agent normalises what it observes are a
    member that `load` leaves alone.
    """
    names, variables = agent._get_torch_save_params()
    left_out = {*agent._excluded_save_params(), *_OF_THIS_PROCESS, *_OF_TRAINING}
    left_out |= {name.partition(".")[0] for name in (*names, *variables)}
    data = {name: value for name, value in vars(agent).items() if name not in left_out}
    statistics = statistics_of(agent)
    members: dict[str, str | bytes] = {
        "data": _to_json(data),
        "pytorch_variables.pth": _to_bytes({name: getattr(agent, name) for name in variables}),
        **{f"{name}.pth": _to_bytes(state) for name, state in agent.get_parameters().items()},
        "_stable_baselines3_version": stable_baselines3.__version__,
        **({STATISTICS: safetensors.numpy.save(statistics.tensors)} if statistics else {}),
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, member in members.items():
            file.writestr(zipfile.ZipInfo(name), member)  # dated 1980, the format's first year
    return content.getvalue()


def _to_json(data: dict[str, Any]) -> str:
    """stable-baselines3's JSON without its notes for human readers, which hold addresses."""
    stated = json.loads(data_to_json(data))
    for name, value in stated.items():
        if isinstance(value, dict) and ":serialized:" in value:
            stated[name] = {key: value[key] for key in (":type:", ":serialized:")}
    return json.dumps(stated, indent=4)


def _to_bytes(tensors: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    torch.save(tensors, content)
    return content.getvalue()
