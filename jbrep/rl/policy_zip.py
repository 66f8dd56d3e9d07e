"""policy.zip, for stable-baselines3 and other programs: written with equal bytes for equal runs."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.numpy
import stable_baselines3
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import data_to_json

from jbrep.records.document import document_from, parse_json
from jbrep.rl.agent import statistics_of
from jbrep.rl.files import ZipHeader
from jbrep.rl.run_settings import RunSettings

STATISTICS = "observation_statistics.safetensors"  # by which an agent normalises what it sees
_HEADER = "trained_on.json"
_OF_TRAINING = {
    "action_noise",  # which may be jbrep's own
    "replay_buffer_class",  # `load` finds the one for n_steps, and warns of one that is given
}
_OF_THIS_PROCESS = {  # wall times, and where the environment was: `load` starts with defaults
    "_last_episode_starts",
    "_last_obs",
    "_last_original_obs",
    "_num_timesteps_at_start",
    "ep_info_buffer",
    "ep_success_buffer",
    "start_time",
}


class ZipMetadata(NamedTuple):
    """What a zip file that jbrep wrote says beside what stable-baselines3 reads."""

    header: ZipHeader
    statistics: dict[str, NDArray[Any]]  # see `jbrep.rl.normalization.Statistics`; perhaps none


def policy_zip(agent: BaseAlgorithm, settings: RunSettings) -> bytes:
    """A zip file that the algorithm's `load` takes, as its `save` writes it.

    Unlike there, members carry a fixed date, whatever the clock says, and nothing in them depends
    on the process or the machine. What the agent observes through, and statistics by which it
    normalises that, are members that `load` leaves alone.
    """
    names, variables = agent._get_torch_save_params()
    left_out = {*agent._excluded_save_params(), *_OF_THIS_PROCESS, *_OF_TRAINING}
    left_out |= {name.partition(".")[0] for name in (*names, *variables)}
    data = {name: value for name, value in vars(agent).items() if name not in left_out}
    statistics = statistics_of(agent)
    header = ZipHeader(
        environment=settings.environment,
        encoder=settings.encoder,
        representation=settings.representation,
    )
    members: dict[str, str | bytes] = {
        "data": _to_json(data),
        "pytorch_variables.pth": _to_bytes({name: getattr(agent, name) for name in variables}),
        **{f"{name}.pth": _to_bytes(state) for name, state in agent.get_parameters().items()},
        "_stable_baselines3_version": stable_baselines3.__version__,
        _HEADER: header.text(),
        **({STATISTICS: safetensors.numpy.save(statistics.tensors)} if statistics else {}),
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name, member in members.items():
            file.writestr(zipfile.ZipInfo(name), member)  # dated 1980, the format's first year
    return content.getvalue()


def read_metadata(raw: bytes, path: Path) -> ZipMetadata | None:
    """What a zip file's bytes say; None if jbrep didn't write them. The path is for messages.

    Raises:
        Exception: of many types, for a file that isn't one.
    """
    members = zipfile.ZipFile(io.BytesIO(raw))
    names = members.namelist()
    if _HEADER not in names:
        return None
    header = document_from(
        parse_json(members.read(_HEADER), path, ZipHeader.format), path, ZipHeader
    )
    has_statistics = STATISTICS in names
    statistics = safetensors.numpy.load(members.read(STATISTICS)) if has_statistics else {}
    return ZipMetadata(header, statistics)


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
