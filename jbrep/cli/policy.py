"""Taking a policy out, for a robot, and checking what was taken out."""

import shlex
from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import PATH, POSITIVE
from jbrep.cli.environment import (
    environment_options,
    given_task,
    retries_option,
    task_option,
    threads_option,
)
from jbrep.cli.output import say
from jbrep.errors import InputError
from jbrep.text import interval_of, returns_text


@click.group(epilog="Example: jbrep policy export runs/a --out controller.onnx")
def policy() -> None:
    """Export a trained policy for a robot, and check the file."""


@policy.command(epilog="Example: jbrep policy export runs/a --out controller.onnx")
@click.argument("policy")
@task_option
@click.option(
    "--format",
    "form",
    default="onnx",
    show_default=True,
    help="onnx, or torch for a program of torch.export.",
)
@click.option("--out", required=True, type=PATH, help="A new file.")
def export(policy: str, task: str | None, form: str, out: Path) -> None:
    """Write a policy as one model, from raw observations to actions.

    POLICY is the folder of a run, a policy's file, or trained, which ships and needs a --task.
    Scaling, encoder, running normalisation, network and bounds are all in the model; names, units,
    ranges and the rate are in its metadata. Each action is to be held for as many control steps as
    the run's action_repeat says.
    """
    from jbrep.envs.description import describe
    from jbrep.envs.names import modules_of
    from jbrep.play.sources import policy_file
    from jbrep.rl.controller import load_policy
    from jbrep.rl.export import described
    from jbrep.rl.export import export as write
    from jbrep.rl.shipped import SHIPPED

    if task and policy != SHIPPED:
        raise InputError(
            f"--task goes with {SHIPPED}, the policy that ships for it; {policy} must be a run's "
            "folder or a policy's file, which say their own: leave out --task"
        )
    controller = load_policy(policy_file(policy, describe(task) if task else None))
    write(controller, out, form)
    said, own = described(controller), controller.task
    rate = "" if said["rate"] is None else f", {said['rate']:g} times a second"
    say(f"{out}: {own.size} numbers of {own.name} to {own.action_size}{rate}")
    if form == "onnx":
        modules = [f"--import={module}" for module in modules_of(own)]
        check = ["jbrep", "policy", "check", str(out), "--run", policy, *modules]
        click.echo(f"check it with {shlex.join(check + (['--task', task] if task else []))}")
    else:
        click.echo(f"open it with torch.export.load({str(out)!r}).module()")


@policy.command(epilog="Example: jbrep policy check controller.onnx --run runs/a")
@click.argument("model", type=PATH)
@click.option("--run", help="The run that it was exported from, or trained, to play beside it.")
@click.option("--episodes", default=20, show_default=True, type=POSITIVE, help="How many.")
@threads_option
@retries_option
@task_option
@environment_options
def check(
    model: Path,
    run: str | None,
    episodes: int,
    threads: int | None,
    retries: int,
    **options: Any,
) -> None:
    """Play an exported policy in its environment.

    MODEL is an ONNX file that jbrep policy export wrote. It plays the episodes that every run is
    evaluated on; with --run, that run plays the same ones.
    """
    import numpy as np

    from jbrep.play.sources import exported_player, find_player

    beside = find_player(run, given_task(options)) if run else None
    player = exported_player(model, beside.task if beside else given_task(options))
    returns = player.returns(episodes, threads, retries)
    say(f"{player.task.name}, {model}: {returns_text(returns)}")
    if beside:
        theirs = beside.returns(episodes, threads, retries)
        apart = float(np.abs(returns - theirs).max())
        said = f"{beside.name}: {interval_of(theirs)}"
        say(f"{said}; no episode's return differs by more than {apart:.3g}")
