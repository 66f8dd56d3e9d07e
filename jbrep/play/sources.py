"""What a user names: an episode of a data set, the policy of a run, or one by its name."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from jbrep.collect.policies import POLICIES, Policy, make_policy, parse_policy
from jbrep.dataset import Dataset
from jbrep.dataset.manifest import MANIFEST
from jbrep.encoders import FULL
from jbrep.envs.task import Task, check_same
from jbrep.errors import InputError
from jbrep.play.jitterbug import jitterbug_task
from jbrep.play.player import Player
from jbrep.play.rollout import Rollout, replay
from jbrep.records.storage import exists
from jbrep.rl.files import POLICY, POLICY_ZIP, check_begun, is_policy_file, is_run
from jbrep.rl.policy_file import SHIPPED, find_shipped

if TYPE_CHECKING:
    from jbrep.evaluate.control import GoodPolicy
    from jbrep.rl.policy import Trained

_HEURISTIC = "heuristic"  # the Jitterbug's hand-written policy
_GOOD_EPISODES = 30  # of a good policy


def find_episode(
    source: str, episode: int = 0, task: Task | None = None, encoder: Any = None
) -> Rollout:
    """An episode of a data set by its number, or one under a policy that `find_player` knows.

    Those under a policy are the episodes of evaluation. A run's come out as they did when it was
    evaluated.
    """
    if exists(Path(source) / MANIFEST):
        dataset = Dataset(source)
        _check_task(source, dataset.task, task)
        if task not in (None, dataset.task):
            raise InputError(
                f"{source} has its own arguments, time limit and features: leave out --task"
            )
        return replay(dataset, episode)
    player = find_player(source, task, encoder)
    if episode < 0:
        raise InputError(f"there is no episode {episode}: they count from 0")
    return player.play_one(episode)


def find_policy(text: str, folder: Path, task: Task) -> Policy:
    """The policy that a text names, to collect with: of a run, by its name, or a mixture of them.

    The policy of a run is frozen: it is the one that the data set has already, or else the run's
    last.

    Args:
        text: the run's folder or a policy's file, a name such as constant:drive=0.5, or a mixture
            such as uniform:0.5+runs/a:0.5.
        folder: of the data set.
        task: of the data set.

    Raises:
        DamageError: a file isn't what was written.
    """
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

    return parse_policy(text, frozen)


def kept_policy(folder: Path) -> Callable[[Mapping[str, Any]], Policy]:
    """How to make the policies of a data set in a folder from what its manifest says of them."""

    def trained(settings: Mapping[str, Any]) -> Policy:
        from jbrep.rl.policy import read_frozen  # imports torch

        return read_frozen(folder, settings)

    return lambda settings: make_policy(settings, trained)


def is_trained(source: str) -> bool:
    """Whether a source is a run, a policy's file, or the policy that ships for a task."""
    return source == SHIPPED or run_folder(source) is not None or is_policy_file(Path(source))


def is_by_name(source: str) -> bool:
    """Whether a source is a policy by its name, which needs a task."""
    return source == SHIPPED or source.partition(":")[0] in POLICIES


def check_source(source: str) -> None:
    """Make sure that a source is something to play or replay, without loading it."""
    if is_trained(source) or is_by_name(source) or exists(Path(source) / MANIFEST):
        return
    check_begun(Path(source))
    raise InputError(
        f"{source} is no data set, no run with a policy or checkpoint, and no policy by name: "
        f"those are {policy_names()}"
    )


def policy_names() -> str:
    """The names of policies, for messages."""
    return ", ".join((*POLICIES, SHIPPED))


def policy_file(source: str, task: Task | None) -> Path:
    """The path of the policy's file that a source names: that path, or the one that ships."""
    return find_shipped(_needed(task, source)) if source == SHIPPED else Path(source)


def find_player(source: str, task: Task | None = None, encoder: Any = None) -> Player:
    """The policy of a run, or one by its name, such as heuristic or constant:drive=0.5.

    Args:
        source: the run's folder, or a policy in it, a policy's file, or the name; trained is
            the one that ships for the task. A run that is not over plays its last checkpoint.
        task: for a policy by its name. A run has its own; if one is given, it must be of the same
            environment, and is played instead: with other arguments or another time limit.
        encoder: the object that a run was made with, if its encoder is a user's own.
    """
    if is_trained(source):
        return _trained(source, task, encoder)
    if exists(Path(source) / MANIFEST):
        raise InputError(f"{source} is a data set: give the folder of a run or a policy")
    check_source(source)
    return Player(source, _needed(task, source), parse_policy(source).begin)


def _needed(task: Task | None, policy: str) -> Task:
    if task is None:
        raise InputError(f"policy {policy} needs a --task")
    return task


def find_good_policy(
    source: str | None, task: Task, own_rewards: bool = False
) -> "GoodPolicy | None":
    """A policy with the episodes that it plays: the first of those that runs are evaluated on.

    Args:
        source: as `find_player` takes it; None for the hand-written policy, if the task has one.
        task: to act in.
        own_rewards: whether rewards are others than the environment gives: nothing is played then.
    """
    if source is None:
        if own_rewards or jitterbug_task(task) is None:
            return None
        source = _HEURISTIC
    known = POLICIES.get(source.partition(":")[0])
    if known is not None and known.open_loop:
        raise InputError(
            f"policy {source} doesn't act on what it observes: give {_HEURISTIC} or a run's folder"
        )
    from jbrep.evaluate.control import GoodPolicy, PlayedEpisode  # imports torch

    player = find_player(source, task)

    def act(observation: NDArray[Any]) -> NDArray[Any]:
        return player.begin(task, range(len(observation)))(observation)

    played = [] if own_rewards else player.play(range(_GOOD_EPISODES))
    episodes = [PlayedEpisode(each.observation, each.reward, each.terminated) for each in played]
    return GoodPolicy(source, act, episodes)


def run_folder(source: str) -> Path | None:
    """The folder of the run that a source names by it, or by a policy in it; None for another."""
    path = Path(source)
    folder = path.parent if path.name in (POLICY, POLICY_ZIP) else path
    return folder if source != SHIPPED and is_run(folder) else None


def find_untrained(folder: Path, task: Task) -> Player:
    """The policy that a run began with, to play a task of the same environment."""
    from jbrep.rl.policy import load_untrained  # imports torch

    return as_player(f"{folder}, before training", load_untrained(folder), task)


def _trained(source: str, task: Task | None, encoder: Any) -> Player:
    from jbrep.rl.policy import (
        load_run,  # imports torch
        of_file,
    )
    from jbrep.rl.policy_file import read

    folder = run_folder(source)
    trained = load_run(folder, encoder) if folder else of_file(read(policy_file(source, task)))
    name = str(folder or source)
    _check_task(name, trained.task, task)
    if trained.step is not None:
        name = f"{name} at step {trained.step:,}"
    return as_player(name, trained, task)


def _check_task(source: str, own: Task, given: Task | None) -> None:
    """Make sure that a task that is given, if any, is the source's."""
    if given and given.id != own.id:
        raise InputError(f"{source} is of {own.name}, not of {given.name}")
    if given:
        check_same(given, own, source)


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
