"""Agents, and what came of them."""

from pathlib import Path

import click

from jbrep.cli.base import COUNT, example


@click.command(epilog=example("jbrep rl --task face_direction --encoder dae-8 --out runs/a"))
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option("--algorithm", default="sac", show_default=True, help="ddpg, td3, sac, ppo or a2c.")
@click.option("--encoder", help="A file, or a name that ships; the full observation if not given.")
@click.option("--steps", default=10_000, show_default=True, type=COUNT, help="Control steps.")
@click.option(
    "--seed",
    type=click.IntRange(0, 2**31),
    default=0,
    show_default=True,
    help="Of agent and environment.",
)
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new folder.")
def rl(task: str, algorithm: str, encoder: str | None, steps: int, seed: int, out: Path) -> None:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent.
    """
    from jbrep.rl import Run, train

    result = train(Run(task, algorithm, encoder, steps, seed), out)
    returns = ", ".join(f"{r:.0f}" for r in result["returns"])
    click.echo(f"returns on {result['representation']}: {returns}; policy and run.json in {out}")


@click.command(epilog=example("jbrep report runs"))
@click.argument("folder", type=click.Path(path_type=Path))
def report(folder: Path) -> None:
    """Show the runs below a folder side by side."""
    from jbrep.report import summarise

    click.echo(summarise(folder))
