"""Training one agent."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, GOES_ON, example, stoppable


@click.command(
    epilog=example("jbrep rl --task face_direction --algorithm ddpg --encoder dae-8 --out runs/a")
)
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option(
    "--algorithm", default="sac", show_default=True, help="ddpg, td3, sac, ppo, a2c or trpo."
)
@click.option(
    "--preset", default="paper", show_default=True, help="Whose settings: paper or modern."
)
@click.option(
    "--encoder",
    default="identity",
    help="A file, or a name that ships; the full observation if not given, scaled the same way.",
)
@click.option("--steps", default=100_000, show_default=True, type=COUNT, help="Control steps.")
@click.option("--seed", default=0, show_default=True, type=COUNT, help="Of agent and episodes.")
@click.option(
    "--evaluate-every", default=10_000, show_default=True, type=COUNT, help="In control steps."
)
@click.option(
    "--evaluation-episodes",
    default=10,
    show_default=True,
    type=COUNT,
    help="Of the deterministic policy, each time, with starts that training doesn't have.",
)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="A folder for this run."
)
@click.pass_context
def rl(context: click.Context, /, out: Path, **settings: Any) -> None:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent. Killed or stopped by Ctrl-C, the
    same command goes on from the last minute's checkpoint, to the same result.
    """
    from jbrep.progress import Progress
    from jbrep.rl import Run, train
    from jbrep.rl.files import EVALUATIONS, read_evaluations

    run = Run(**settings)
    run.check()
    with (
        stoppable(GOES_ON),
        Progress(
            total=run.steps, desc=f"{run.algorithm} on {run.encoder}", unit="step", delay=0.5
        ) as progress,
    ):

        def watch(step: int, mean: float | None) -> None:
            progress.update(step - progress.n)
            progress.set_postfix(evaluation="-" if mean is None else f"{mean:.0f}", refresh=False)

        result = train(run, out, watch)
    if "reason" in result:
        click.echo(f"the run failed: {result['reason']}; {out / 'run.json'} keeps it", err=True)
        context.exit(1)
    rows = read_evaluations(out)
    returns = ", ".join(f"{e.episode_return:.0f}" for e in rows if e.step == rows[-1].step)
    name = result["settings"]["representation"]
    click.echo(f"returns on {name} at the end: {returns}; {out / EVALUATIONS} has those before")
