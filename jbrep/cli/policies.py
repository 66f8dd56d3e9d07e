"""What policies do."""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from jbrep.cli.base import PATH, POSITIVE, as_json
from jbrep.cli.completion import complete_encoder
from jbrep.cli.environment import (
    environment_options,
    given_task,
    retries_option,
    task_option,
    threads_option,
)
from jbrep.cli.output import echo_json, echo_paths, say, tell
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.text import counted, interval_of, percentiles, table, terminal_width

if TYPE_CHECKING:
    from jbrep.envs.infos import Numbers
    from jbrep.envs.task import Task
    from jbrep.play.player import Player

_TASK = "face_direction"


@click.command(epilog="Example: jbrep evaluate-policy runs/a --episodes 100")
@click.argument("policy")
@click.option(
    "--episodes", default=20, show_default=True, type=POSITIVE, help="How many, the same each time."
)
@click.option("--trust", is_flag=True, help="Read a zip file from elsewhere, which can run code.")
@task_option
@threads_option
@retries_option
@click.option("--algorithm", help="Of a zip file.  [default: sac]")
@click.option(
    "--vecnormalize",
    type=PATH,
    metavar="FILE",
    help="What VecNormalize.save wrote, if a zip file's agent was trained behind that.",
)
@click.option(
    "--encoder",
    shell_complete=complete_encoder,
    help="What a zip file was trained on, or what a policy by name observes through: a file, the "
    "name of one that ships, or code, mymodule:MyEncoder; of a run that was made with code, that.",
)
@click.option(
    "--perturb",
    "perturbations",
    multiple=True,
    is_flag=False,
    flag_value="",
    metavar="[NAME=VALUE]",
    help="Play the episodes undisturbed, then with noise, delays, other bodies, pushes, ...: all "
    "that there can be, or what is named, as in --perturb delay=2 or noise=0.1,delay=1..3; may be "
    "repeated.",
)
@click.option("--out", type=PATH, help="A new JSON file for the table of --perturb.")
@environment_options
@as_json
@click.pass_context
def evaluate_policy(
    context: click.Context,
    /,
    policy: str,
    episodes: int,
    threads: int | None,
    retries: int,
    trust: bool,
    algorithm: str | None,
    vecnormalize: Path | None,
    encoder: str | None,
    perturbations: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Show the returns of a policy.

    POLICY is a folder of jbrep rl, a zip file that stable-baselines3 wrote, or a policy by its
    name, such as heuristic, or trained, which ships. A name is played on face_direction unless
    --task is given; a zip file needs it unless jbrep wrote it. A run that is under way or was
    stopped plays its last checkpoint. Of a folder only numbers are read. A zip file from elsewhere
    runs as code when it is opened, so it needs --trust; its agent sees what the environment gives,
    unless jbrep wrote it, or --encoder and --vecnormalize say what it was trained on. A policy by
    name may act on what an encoder's latent is decoded to: the return that it loses measures what
    the latent lacks.

    With --perturb they are a table: how much of its return a policy keeps where sensors are noisy
    or late, readings are lost, the body or the physics is another, or the robot is pushed.
    """
    from jbrep.encoders.shipped import source_of
    from jbrep.envs.names import import_code
    from jbrep.play.sources import is_by_name

    import_code(encoder)
    _check_perturbations(perturbations, out)
    zip_file = _Zip(algorithm, trust, vecnormalize)
    if is_by_name(policy):
        options["task"] = options["task"] or _TASK
    player = _find(policy, given_task(options), encoder, zip_file)
    source = None if encoder is None else source_of(encoder, player.task)
    if perturbations:
        chosen = [each for each in perturbations if each]
        return _perturb(policy, player, chosen, (episodes, threads, retries), out, as_json)
    returns, numbers, failure = _outcome(player, episodes, threads, retries)
    _show_returns(policy, player, source, returns, numbers, as_json)
    if failure:
        say(f"Error: {failure}; {len(returns)} of {episodes} episodes were finished", err=True)
        context.exit(1)
    return None


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
        return echo_json(
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
    if told := shares_text(by_name(numbers)):
        tell(told)
    return None


def _check_perturbations(perturbations: tuple[str, ...], out: Path | None) -> None:
    from jbrep.play.perturbed import read_perturbation
    from jbrep.records.storage import exists, taken

    for each in filter(None, perturbations):
        read_perturbation(each)
    if out and not perturbations:
        raise InputError("--out is for the table of --perturb: add that")
    if out and exists(out):
        raise taken(out)


def _perturb(
    policy: str,
    player: "Player",
    chosen: Sequence[str],
    how: tuple[int, int | None, int],
    out: Path | None,
    as_json: bool,
) -> None:
    """Show the rows of a table as they are finished, and write those so far."""
    from jbrep.play.perturbed import HEADER, Table, domains_of, perturb
    from jbrep.records.storage import make_folder

    if out:
        make_folder(out.parent)
    domains, lacking = domains_of(player.task, chosen)
    if lacking and not chosen:
        told = f"{player.task.name} has no {', '.join(lacking)} that could be changed"
        tell(f"Note: {told}: left out", err=True)
    result = Table(
        policy=policy,
        task=player.task.name,
        representation=player.representation,
        step=player.step,
        rows=(),
    )
    left = max(map(len, (*domains, HEADER[0])))
    if not as_json:
        tell(f"{_title(policy, player)}, each row the same {counted(how[0], 'episode')}")
        say("")
        say(_line(HEADER, left))
    with stoppable("the rows so far are complete"):
        for row in perturb(player, domains, *how):
            result = result.replace(rows=(*result.rows, row))
            if out:
                result.write(out)
            if not as_json:
                say(_line(row.cells, left))
    if as_json:
        echo_json(to_plain(result))
    elif out:
        echo_paths([out])


def _line(cells: Sequence[str], left: int) -> str:
    first, *others = cells
    return "  ".join((first.ljust(left), *(cell.rjust(25) for cell in others)))


def _outcome(
    player: "Player", episodes: int, threads: int | None, retries: int
) -> tuple[list[float], "list[Numbers]", str]:
    """The returns and infos of the episodes that were finished, and why others weren't.

    Raises:
        EnvironmentFailedError: none was.
    """
    from jbrep.envs.lanes import EnvironmentFailedError

    returns: list[float] = []
    numbers: list[Numbers] = []
    try:
        for some in player.outcomes_in_turn(episodes, threads, retries):
            returns += some.returns.tolist()
            numbers += some.numbers
    except EnvironmentFailedError as error:
        if not returns:
            raise
        return returns, numbers, str(error)
    return returns, numbers, ""


def _title(policy: str, player: "Player") -> str:
    """The task, and what is not in the command: what a trained policy observes, its step."""
    from jbrep.play.sources import is_by_name

    if is_by_name(policy):
        return f"{player.task.name}, {player.name}"
    step = "" if player.step is None else f" at step {player.step:,}"
    return f"{player.task.name} on {player.representation}{step}"


class _Zip(NamedTuple):
    """What is said of a zip file."""

    algorithm: str | None
    trust: bool
    vecnormalize: Path | None

    def player(self, path: Path, task: "Task | None", encoder: str | None) -> "Player":
        """The policy in it; what it doesn't tell is noted."""
        from jbrep.play.sources import as_player
        from jbrep.rl.policy_zip import load_zip  # imports torch

        algorithm = self.algorithm or "sac"
        found = load_zip(path, task, algorithm, encoder, self.trust, self.vecnormalize)
        if found.note:
            say(f"note: {found.note}", err=True)
        return as_player(str(path), found.trained, task)


def _find(policy: str, task: "Task | None", encoder: str | None, zip_file: _Zip) -> "Player":
    """The policy of a run, by name, or in a zip file."""
    from jbrep.encoders import find
    from jbrep.play import sources

    path, folder = Path(policy), sources.run_folder(policy)
    is_folder = path.is_dir()
    is_zip = not (sources.is_by_name(policy) or sources.is_trained(policy) or is_folder)
    if not is_zip and (unused := [name for name, given in zip_file._asdict().items() if given]):
        raise InputError(f"--{unused[0]} is for zip files from elsewhere: leave it out")
    if sources.is_trained(policy) or is_folder:
        if encoder and not (folder and encoder == _code_of(folder)):
            raise InputError(
                f"{policy} is a trained policy, which has its own encoder: leave out --encoder"
            )
        return sources.find_player(policy, task)
    if sources.is_by_name(policy):
        player = sources.find_player(policy, task)
        return player.with_reconstruction(find(encoder, player.task)) if encoder else player
    if not zipfile.is_zipfile(path):
        raise InputError(
            f"no policy at {policy}: a folder of jbrep rl is needed, a zip file of "
            f"stable-baselines3, or a name: {sources.policy_names()}"
        )
    return zip_file.player(path, task, encoder)


def _code_of(folder: Path) -> str | None:
    """The code of the encoder that a run was made with, if it is code."""
    from jbrep.rl.checkpoint import run_settings  # imports torch

    return run_settings(folder).encoder_code


@click.command(epilog="Example: jbrep policies")
@as_json
def policies(as_json: bool) -> None:
    """Show the trained policies that ship.

    Every command that takes a policy knows the one for its --task as trained, as in jbrep render
    trained --task face_direction --out walk.mp4.
    """
    from jbrep.rl.policy_file import SHIPPED, shipped

    ships = shipped()
    if as_json:
        return echo_json(
            {
                policy.task: {
                    "observes": policy.observes,
                    "learner": policy.learner,
                    "steps": policy.steps,
                    "episodes": len(policy.returns[SHIPPED]),
                    **{name: percentiles(each) for name, each in policy.returns.items()},
                }
                for policy in ships
            }
        )
    rows = [
        (task, observes, learner, f"{steps:,}", *map(interval_of, returns.values()))
        for task, observes, learner, steps, returns in ships
    ]
    header = ("task", "observes", "learned by", "steps", *ships[0].returns)
    click.echo(table(header, rows, terminal_width()))
    episodes = len(ships[0].returns[SHIPPED])
    click.echo(f"\nreturns: median [10 %, 90 %] of the same {episodes} episodes")
    return tell("falling: the preset wide, but with a learning rate that falls to 0")
