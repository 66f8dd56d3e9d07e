"""What policies do, and taking one out for a robot."""

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from jbrep.cli.base import command, say, say_json, tell
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError
from jbrep.parameters import AsJson, Episodes, NewFile, Retries, TaskName, Threads, described
from jbrep.text import counted, interval_of, percentiles, table, terminal_width

if TYPE_CHECKING:
    from jbrep.envs.infos import Numbers
    from jbrep.play.player import Player

_TASK = "face_direction"
_MAYBE = {"is_flag": False, "flag_value": ""}  # an option that may have no value


@command("policies")
def policies() -> None:
    """Show the trained policies that ship.

    Every command that takes a policy knows the one for its --task as trained, as in jbrep render
    trained --task face_direction --out walk.mp4.
    """
    from jbrep.rl.policy_file import SHIPPED, shipped

    ships = shipped()
    rows = [
        (task, observes, learner, f"{steps:,}", *map(interval_of, returns.values()))
        for task, observes, learner, steps, returns in ships
    ]
    header = ("task", "observes", "learned by", "steps", *ships[0].returns)
    say(table(header, rows, terminal_width()))
    episodes = len(ships[0].returns[SHIPPED])
    say(f"\nreturns: median [10 %, 90 %] of the same {episodes} episodes")
    tell("falling: the preset wide, with a learning rate that decays to 0")


@command("policy export runs/a --out controller.onnx")
def export(
    policy: str, /, out: NewFile, *, task: TaskName = None, with_example: bool = False
) -> None:
    """Write a policy as one ONNX model, from raw observations to actions.

    POLICY is the folder of a run, a policy's file, or trained, which ships and needs a --task.
    Scaling, encoder, running normalisation, network and bounds are all in the model; names, units,
    ranges and the rate are in its metadata. Each action is to be held for as many control steps as
    the run's action_repeat says.

    Args:
        with_example: write a control loop beside it, which checks sensors and needs no jbrep.
    """
    from jbrep.envs.description import describe
    from jbrep.envs.names import modules_of, spec_of
    from jbrep.play.sources import policy_file
    from jbrep.records.storage import exists, taken, write_new
    from jbrep.rl.controller import EXAMPLE, described, load_policy
    from jbrep.rl.controller import export as write
    from jbrep.rl.policy_file import SHIPPED

    if task and policy != SHIPPED:
        raise InputError(
            f"--task goes with {SHIPPED}, the policy that ships for it; {policy} must be a run's "
            "folder or a policy's file, which say their own: leave out --task"
        )
    controller = load_policy(policy_file(policy, describe(task) if task else None))
    loop = out.with_name(f"{out.stem}_loop.py")
    if with_example and exists(loop):
        raise taken(loop)
    write(controller, out)
    if with_example:
        write_new(loop, EXAMPLE.read_bytes())
    said, own = described(controller), controller.task
    rate = "" if said["rate"] is None else f", {said['rate']:g} times a second"
    say(f"{out}: {own.size} numbers of {own.name} to {own.action_size}{rate}")
    if with_example:
        say(f"run it with {shlex.join(('python', str(loop), str(out)))}")
    modules = [f"--import={module}" for module in modules_of(own)]
    check = ["jbrep", "evaluate-policy", str(out), "--beside", policy, *modules]
    with suppress(InputError):  # where it comes of a log alone
        spec_of(own)
        say(f"check it with {shlex.join(check)}")


@command("evaluate-policy runs/a --episodes 100")
def evaluate_policy(
    policy: Annotated[str, Meta(extra={"is_code": True})],
    /,
    *,
    episodes: Episodes = 20,
    threads: Threads = None,
    retries: Retries = 0,
    encoder: Annotated[str | None, Meta(extra={"is_code": True})] = None,
    beside: str | None = None,
    perturb: Annotated[
        Sequence[str], Meta(extra={"metavar": "[NAME=VALUE]", "click": _MAYBE})
    ] = (),
    out: Path | None = None,
    as_json: AsJson = False,
    **options: Annotated[Any, described],
) -> bool:
    """Show the returns of a policy.

    POLICY is a folder of jbrep rl, a file that jbrep policy export wrote, a policy by its name,
    such as heuristic, or trained, which ships, or your own: mymodule:act, a function of an
    observation, a class of such functions, or a stable-baselines3 model. A name is played on
    face_direction unless --task is given; your own needs it. A run that is under way or was stopped
    plays its last checkpoint. A policy by name may act on what an encoder's latent is decoded to:
    the return that it loses measures what the latent lacks.

    --perturb prints a table: how much of its return a policy keeps where sensors are noisy
    or late, readings are lost, the body or the physics is another, or the robot is pushed.

    Args:
        encoder: what a policy by name observes through: a file, the name of one that ships, or
            code, mymodule:MyEncoder; of a run that was made with code, that.
        beside: another policy, such as the run that a file was exported from: it plays the same
            episodes, whose returns are compared.
        perturb: play the episodes undisturbed, then with noise, delays, other bodies, pushes, ...:
            all that there can be, or what is named, as in --perturb delay=2 or
            noise=0.1,delay=1..3; may be repeated.
        out: a new JSON file for the table of `perturb`.
    """
    from jbrep.encoders.shipped import source_of
    from jbrep.envs.environments import EnvironmentFailedError
    from jbrep.envs.infos import Numbers
    from jbrep.play.sources import find_player

    chosen = _perturbations(perturb, beside, out)
    player, how = _find(policy, encoder, options), (threads, retries)
    source = None if encoder is None else source_of(encoder, player.task)
    other = find_player(beside, player.task) if beside else None
    if perturb:
        _perturb(policy, player, chosen, episodes, how, out, as_json)
        return False
    returns, numbers, failure = list[float](), list[Numbers](), ""
    try:
        for some in player.outcomes_in_turn(episodes, *how):
            returns += some.returns.tolist()
            numbers += some.numbers
    except EnvironmentFailedError as error:
        if not returns:
            raise
        failure = str(error)
    _show_returns(policy, player, source, returns, numbers, as_json)
    if other and not failure:
        theirs = other.returns(episodes, *how)
        apart = max(abs(a - b) for a, b in zip(returns, theirs.tolist(), strict=True))
        tell(f"{other.name}: {interval_of(theirs)}; returns differ by at most {apart:.3g}", as_json)
    if failure:
        say(f"Error: {failure}; {len(returns)} of {episodes} episodes were finished", err=True)
    return bool(failure)


def _perturbations(perturb: Sequence[str], beside: str | None, out: Path | None) -> list[str]:
    """Those that are named, if the options go together."""
    from jbrep.play.perturbed import read_perturbation
    from jbrep.records.storage import exists, taken

    if beside and perturb:
        raise InputError("--beside compares returns: leave out --perturb")
    if out and not perturb:
        raise InputError("--out needs --perturb, whose table it is for")
    if out and exists(out):
        raise taken(out)
    chosen = [each for each in perturb if each]
    for each in chosen:
        read_perturbation(each)
    return chosen


def _show_returns(
    policy: str,
    player: "Player",
    source: str | None,
    returns: list[float],
    numbers: "list[Numbers]",
    as_json: bool,
) -> None:
    from jbrep.envs.infos import by_name, shares_text

    if as_json:
        return say_json(
            {
                "policy": policy,
                "task": player.task.name,
                "representation": player.representation,
                **({} if source is None else {"encoder": source}),
                **({} if player.step is None else {"step": player.step}),
                "episodes": len(returns),
                "returns": returns,
                **percentiles(returns),
                **({"infos": numbers} if any(numbers) else {}),
            }
        )
    if source is not None:
        say(f"encoder: {source}")
    title, played = _title(policy, player), counted(len(returns), "episode")
    tell(f"{title}: median return {interval_of(returns)} (10-90 % of {played})")
    if shares := shares_text(by_name(numbers)):
        tell(shares)
    return None


def _perturb(
    policy: str,
    player: "Player",
    chosen: Sequence[str],
    episodes: int,
    how: tuple[int | None, int],
    out: Path | None,
    as_json: bool,
) -> None:
    """Show how much of its return a policy keeps, and write that."""
    from jbrep.play.perturbed import HEADER, PerturbationTable, domains_of, perturb
    from jbrep.records.storage import make_folder

    if out:
        make_folder(out.parent)
    domains, lacking = domains_of(player.task, chosen)
    if lacking and not chosen:
        tell(f"Note: left out, as {player.task.name} lacks it: {', '.join(lacking)}", err=True)
    with stoppable("no table was made"):
        rows = tuple(perturb(player, domains, episodes, *how))
    result = PerturbationTable(
        policy=policy,
        task=player.task.name,
        representation=player.representation,
        step=player.step,
        rows=rows,
    )
    if out:
        result.write(out)
    if as_json:
        return say_json(result.as_json())
    tell(f"{_title(policy, player)}, each row the same {counted(episodes, 'episode')}")
    say(f"\n{table(HEADER, [row.cells for row in rows], terminal_width())}")
    return say(f"\n{out}") if out else None


def _title(policy: str, player: "Player") -> str:
    """The task, and what is not in the command: what a trained policy observes, its step."""
    from jbrep.play.sources import is_by_name, is_exported

    if is_by_name(policy) or is_exported(policy):
        return f"{player.task.name}, {player.name}"
    step = "" if player.step is None else f" at step {player.step:,}"
    return f"{player.task.name} on {player.representation}{step}"


def _find(policy: str, encoder: str | None, options: dict[str, Any]) -> "Player":
    """The policy on the task of these options, maybe on what an encoder's latent is decoded to."""
    from jbrep.encoders import find
    from jbrep.envs.names import is_code
    from jbrep.play import sources
    from jbrep.rl.policy_file import SHIPPED

    by_name = sources.is_by_name(policy)
    if by_name and not is_code(policy):
        options.setdefault("task", _TASK)
    task = described(**options)
    if encoder is None or not by_name or policy == SHIPPED:
        return sources.find_player(policy, task, encoder)
    player = sources.find_player(policy, task)
    return player.with_reconstruction(find(encoder, player.task))
