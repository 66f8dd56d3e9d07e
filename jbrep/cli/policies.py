"""What policies do."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import POSITIVE, echo_paths, example, printable, stoppable


@click.command(epilog=example("jbrep evaluate-policy runs/a --episodes 100"))
@click.argument("policy")
@click.option(
    "--episodes", default=20, show_default=True, type=POSITIVE, help="How many, the same each time."
)
@click.option("--trust", is_flag=True, help="Read a zip file from elsewhere, which can run code.")
@click.option(
    "--task",
    default="face_direction",
    show_default=True,
    help="Of a zip file, or of a policy by name.",
)
@click.option("--algorithm", default="sac", show_default=True, help="Of a zip file.")
@click.option("--encoder", help="That a zip file was trained on; or between robot and policy.")
def evaluate_policy(
    policy: str, episodes: int, trust: bool, task: str, algorithm: str, encoder: str | None
) -> None:
    """Show the returns of a policy.

    POLICY is a folder of jbrep rl, a zip file that stable-baselines3 wrote, or a policy by its
    name, such as heuristic. Of a folder only numbers are read. A zip file runs as code when it is
    opened, so it needs --trust. A policy by name may act on what an encoder's latent is decoded
    to: what it loses by that is what the latent lacks for it.
    """
    import numpy as np

    name, returns = _play(policy, episodes, trust, task, algorithm, encoder)
    low, median, high = np.percentile(returns, (10, 50, 90))
    click.echo(
        printable(
            f"{name}: median return {median:.0f} [{low:.0f}, {high:.0f}] "
            f"(10th and 90th percentile of {episodes} episodes)"
        )
    )


def _play(
    policy: str, episodes: int, trust: bool, task: str, algorithm: str, encoder: str | None
) -> tuple[str, Any]:
    """What was played, and the returns."""
    from jbrep.collect.policies import POLICIES
    from jbrep.encoders import find
    from jbrep.rollouts.sources import find_player

    if policy.partition(":")[0] in POLICIES:
        player = find_player(policy, task)
        if encoder:
            player = player.with_reconstruction(find(encoder, player.task.name))
        played = player.play(range(episodes))
        return f"{task}, {player.name}", [rollout.reward.sum() for rollout in played]

    from jbrep.rl.agent import Evaluator  # brings torch, which no policy by name needs
    from jbrep.rl.policy import load_run, load_zip

    if Path(policy).is_dir():
        trained = load_run(Path(policy))
    else:
        trained = load_zip(Path(policy), task, algorithm, encoder or "identity", trust)
    returns = Evaluator(trained.task, trained.encoder, episodes).returns(trained.policy)
    return f"{trained.task} on {trained.encoder.name}", returns


@click.command(epilog=example("jbrep behaviour runs/full runs/dae-4 --out behaviour"))
@click.argument("policies", nargs=-1, required=True)
@click.option("--task", help="Of policies by name, such as move_in_direction.")
@click.option("--episodes", default=100, show_default=True, type=POSITIVE, help="Of each policy.")
@click.option(
    "--target-yaw", default=45.0, show_default=True, help="Where every target points [degrees]."
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A folder.")
def behaviour(
    policies: tuple[str, ...], task: str | None, episodes: int, target_yaw: float, out: Path
) -> None:
    """Draw how policies turn the motor and where they go.

    A policy is the folder of a run, shown before and after training, or goes by its name, such as
    heuristic. All play the same episodes.
    """
    import numpy as np

    from jbrep.figures import behaviour_plots, write
    from jbrep.rollouts.behaviour import SPEEDS, observe

    yaw = np.deg2rad(target_yaw)
    with stoppable("the same command starts anew"):
        found, behaviours = observe(policies, task, episodes, yaw)
    for each in behaviours:
        low, median, high = np.percentile(each.returns, (10, 50, 90))
        click.echo(printable(f"{each.name}: median return {median:.0f} [{low:.0f}, {high:.0f}]"))
    echo_paths(write(behaviour_plots(found.name, behaviours, SPEEDS, yaw), out))
