"""What a user names: an episode of a data set, or a policy, of a run, a file or their own."""

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta
from numpy.typing import NDArray

from jbrep.collecting.policies import POLICIES, Policy, UserPolicy, parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import FULL
from jbrep.envs.names import is_code
from jbrep.envs.recording import Actor, held
from jbrep.envs.task import Array, Task, check_same
from jbrep.errors import DamageError, InputError, first_line, refusing
from jbrep.jitterbug.tasks import jitterbug_task
from jbrep.play.player import Player
from jbrep.play.rollout import Rollout, replay
from jbrep.records.storage import exists, read_file
from jbrep.rl.files import POLICY, POLICY_ZIP, check_begun, is_policy_file, is_run
from jbrep.rl.policy_file import SHIPPED, find_shipped

if TYPE_CHECKING:
    from jbrep.evaluation.control import GoodPolicy
    from jbrep.rl.policy import Trained

_HEURISTIC = "heuristic"  # the Jitterbug's scripted policy
_GOOD_EPISODES = 30  # of a good policy
_OWN_ENCODER = "{} has its own encoder: leave out the encoder"


def find_episode(
    source: str, episode: int = 0, task: Task | None = None, encoder: Any = None
) -> Rollout:
    """An episode of a data set by its number, or one under a policy that `find_player` knows.

    Those under a policy are the episodes of evaluation. A run's come out as they did when it was
    evaluated.
    """
    if exists(Path(source) / MANIFEST):
        dataset = Dataset(source)
        if task:
            check_same(task, dataset.task, source)
        if task not in (None, dataset.task):
            raise InputError(
                f"{source} has its own arguments, time limit and features: leave out `task`"
            )
        return replay(dataset, episode)
    return find_player(source, task, encoder).play_one(episode)


def find_policy(given: Any, folder: Path, task: Task) -> Policy:
    """The policy to collect with in the folder of a data set.

    It is named by the folder of a run, the file of a policy, a name such as constant:drive=0.5,
    code, mymodule:act, or a mixture such as uniform:0.5+runs/a:0.5; or it is a user's own object,
    as `UserPolicy` takes it. The policy of a run is frozen: it is the one that the data set has
    already, or else the run's last.
    """
    if not isinstance(given, (str, Path)):
        return UserPolicy.of(given)
    taken: list[str] = []

    def frozen(part: str) -> Policy | None:
        by_name = part.partition(":")[0] in POLICIES
        if not is_trained(part) and (by_name or not any(folder.glob("policy-*.safetensors"))):
            return None
        from jbrep.rl.policy import freeze, kept  # imports torch

        file, run = f"policy-{len(taken)}.safetensors", run_folder(part)
        source = str(run or part)
        found = kept(source, folder / file)  # it stays, even if the run has gone on since
        if not found and is_trained(part):
            found = freeze(source, run or policy_file(part, task), file)
        taken.extend([file] if found else [])
        return found

    return parse_policy(str(given), frozen)


def is_trained(source: str) -> bool:
    """Whether a source is a run, a policy's file, or the policy that ships for a task."""
    return source == SHIPPED or run_folder(source) is not None or is_policy_file(Path(source))


def is_by_name(source: str) -> bool:
    """Whether a source is a policy by its name or code, which needs a task."""
    return source == SHIPPED or source.partition(":")[0] in POLICIES or is_code(source)


def check_source(source: str) -> None:
    """Make sure that a source is something to play or replay, without loading it."""
    known = is_trained(source) or is_by_name(source) or is_exported(source)
    if known or exists(Path(source) / MANIFEST):
        return
    check_begun(Path(source))
    raise InputError(
        f"{source} is no data set, no run with a policy or checkpoint, no exported policy, and no "
        f"policy by name: those are {', '.join((*POLICIES, SHIPPED))}, and your own as "
        "module:function"
    )


def policy_file(source: str, task: Task | None) -> Path:
    """The path of the policy's file that a source names: that path, or the one that ships."""
    return find_shipped(_needed(task, source)) if source == SHIPPED else Path(source)


def find_player(source: Any, task: Task | None = None, encoder: Any = None) -> Player:
    """The policy of a run, in a file, by its name, or a user's own.

    Args:
        source: the folder of a run, or a policy in it, which plays its last checkpoint if it is not
            over; the file of a policy, also an exported one; a name, such as constant:drive=0.5, or
            trained, which ships for the task; or what `UserPolicy` takes, or its code, such as
            mymodule:act.
        task: for a policy by its name or a user's own. Others have their own; if one is given, it
            must be of the same environment, and is played instead: with other arguments or another
            time limit.
        encoder: the one that a run was made with, if that is a user's own.
    """
    if not isinstance(source, (str, Path)):
        own = UserPolicy.of(source)
        return Player(own.name, _needed(task, own.name), own.begin)
    source = str(source)
    if is_trained(source):
        return _trained(source, task, encoder)
    if exists(Path(source) / MANIFEST):
        raise InputError(f"{source} is a data set: give the folder of a run or a policy")
    if is_exported(source):
        if encoder is not None:
            raise InputError(_OWN_ENCODER.format(source))
        return _exported(Path(source), task)
    check_source(source)
    return Player(source, _needed(task, source), parse_policy(source).begin)


def _needed(task: Task | None, policy: str) -> Task:
    if task is None:
        raise InputError(f"policy {policy} needs a `task`")
    return task


def find_good_policy(source: Any, task: Task, own_rewards: bool = False) -> "GoodPolicy | None":
    """A policy with the episodes that it plays: the first of those that runs are evaluated on.

    Without a source it is the scripted policy, if the task has one. Nothing is played where
    rewards are others than the environment gives.
    """
    if source is None:
        if own_rewards or jitterbug_task(task) is None:
            return None
        source = _HEURISTIC
    known = POLICIES.get(str(source).partition(":")[0])
    if known is not None and known.open_loop:
        raise InputError(
            f"policy {source} doesn't act on what it observes: give {_HEURISTIC} or a run's folder"
        )
    from jbrep.evaluation.control import GoodPolicy, PlayedEpisode  # imports torch

    player = find_player(source, task)

    def act(observation: NDArray[Any]) -> NDArray[Any]:
        return player.begin(task, range(len(observation)))(observation)

    played = [] if own_rewards else player.play(range(_GOOD_EPISODES))
    episodes = [PlayedEpisode(each.observation, each.reward, each.terminated) for each in played]
    return GoodPolicy(player.name, act, episodes)


def run_folder(source: str) -> Path | None:
    """The folder of the run that a source names by it, or by a policy in it; None for another."""
    path = Path(source)
    folder = path.parent if path.name in (POLICY, POLICY_ZIP) else path
    return folder if source != SHIPPED and is_run(folder) else None


def frozen_file(source: str) -> Path | None:
    """The file that holds the policy a source names; None of one by name or code, or that ships."""
    if (folder := run_folder(source)) and exists(folder / POLICY):
        return folder / POLICY
    path = Path(source)
    return path if is_exported(source) or is_policy_file(path) else None


def _trained(source: str, task: Task | None, encoder: Any) -> Player:
    from jbrep.rl.policy import (
        load_run,  # imports torch
        of_file,
    )
    from jbrep.rl.policy_file import read

    folder = run_folder(source)
    if encoder is not None and folder is None:
        raise InputError(_OWN_ENCODER.format(source))
    trained = load_run(folder, encoder) if folder else of_file(read(policy_file(source, task)))
    name = str(folder or source)
    if task:
        check_same(task, trained.task, name)
    if trained.step is not None:
        name = f"{name} at step {trained.step:,}"
    return as_player(name, trained, task)


def as_player(name: str, trained: "Trained", task: Task | None = None) -> Player:
    """A trained policy with a name; its own task is played if none is given."""
    return Player(
        name,
        task or trained.task,
        trained.begin,
        trained.representation,
        trained.evaluation_episodes,
        trained.step,
        None if trained.encoder.kind == FULL else trained.encoder,
    )


# policies in exported files, played as a robot would run them


class PolicyMetadata(msgspec.Struct):
    """What playing needs of what an exported policy says of itself."""

    environment: Task
    action_repeat: Annotated[int, Meta(ge=1)]
    chunk: Annotated[int, Meta(ge=1)] = 1


def read_exported(path: Path) -> tuple[Any, PolicyMetadata]:
    """The session of onnxruntime that computes a policy's actions, and what the file says of it."""
    from jbrep.encoders.imported import session  # imports onnx
    from jbrep.rl.controller import NOT_SEALED, SEAL

    what = f"{path} isn't an ONNX model that can be run"
    content = read_file(path)
    with refusing(what, describe=first_line, kind=DamageError):
        made = session(content)
        known = made.get_modelmeta().custom_metadata_map
    try:
        metadata = msgspec.json.decode(known.get("jbrep", ""), type=PolicyMetadata)
    except msgspec.DecodeError:  # also of a field that doesn't fit
        raise InputError(f"{path} isn't a policy that jbrep policy export wrote") from None
    seal = known.get(SEAL, "")
    plain = content.replace(seal.encode(), NOT_SEALED.encode()) if seal else content
    if hashlib.sha256(plain).hexdigest() != seal:
        raise DamageError(f"{path} is damaged: it isn't what was exported, by its SHA-256")
    return made, metadata


def is_exported(source: str) -> bool:
    """Whether a source is the file of an exported policy."""
    return source.endswith(".onnx") and exists(Path(source))


def _exported(path: Path, task: Task | None) -> Player:
    """The policy in a file, to play its own task, maybe with another body or time limit."""
    session, said = read_exported(path)
    known = task or said.environment
    check_same(known, said.environment, str(path))
    (given,), (made,) = session.get_inputs(), session.get_outputs()
    sizes = given.shape[1], made.shape[1]
    if sizes != (known.size, said.chunk * known.action_size):
        raise InputError(
            f"{path} takes {sizes[0]} numbers and gives {sizes[1]}, but {known.name} observes "
            f"{known.size} and acts by {known.action_size}: give its `task`"
        )

    def act(observation: Array) -> NDArray[Any]:
        with refusing(f"{path} can't be run", describe=first_line):
            (action,) = session.run([made.name], {given.name: observation.astype("float32")})
        return action

    def begin(task: Task, seeds: Any) -> Actor:
        return held(act, said.action_repeat, said.chunk)

    return Player(str(path), known, begin)
