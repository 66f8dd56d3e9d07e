"""Searching settings."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, POSITIVE, RESUMES, example
from jbrep.cli.environment import task_options
from jbrep.cli.options import record_options
from jbrep.cli.rl import given_run, learner_options, stop_signals
from jbrep.rl.settings import TrainingSettings
from jbrep.text import rounded


@click.command(
    epilog=example(
        "jbrep tune --task face_direction --algorithm sac --preset modern --trials 20 --steps 20k "
        "--out runs/tune"
    )
)
@task_options()
@learner_options
@click.option("--trials", default=20, show_default=True, type=POSITIVE, help="In all.")
@click.option("--seeds", default=1, show_default=True, type=POSITIVE, help="Runs of each trial.")
@click.option("--seed", default=0, show_default=True, type=COUNT, help="Of the search and runs.")
@record_options(TrainingSettings, "steps", "evaluation_episodes", steps=20_000)
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="A folder for this search."
)
@click.pass_context
def tune(context: click.Context, /, out: Path, trials: int, seeds: int, **options: Any) -> None:
    """Search for an algorithm's settings with Optuna.

    Learning rate, batch size, discount, layers and others of the algorithm are searched, but for
    those that --set gives. The score of a trial is the mean return of its runs' last evaluations.
    The best settings are written as a preset file, for --preset. The same command resumes a search;
    --trials may grow.
    """
    with stop_signals() as received:
        from jbrep.rl import StoppedError
        from jbrep.rl.tune import BEST, Trial
        from jbrep.rl.tune import tune as search

        def show(trial: Trial) -> None:
            score = "failed" if trial.value is None else rounded(trial.value)[0]
            click.echo(f"trial {trial.number + 1} of {trials}: {score}  {_shown(trial.overrides)}")

        steps, episodes = options["steps"], options["evaluation_episodes"]
        run = given_run(options, evaluate_every=steps, final_episodes=episodes)
        try:
            best = search(run, trials, seeds, out, show, stop=lambda: bool(received))
        except StoppedError as error:
            click.echo(f"{error} of a trial; {RESUMES}", err=True)
            context.exit(128 + received[0])
    click.echo(f"\nbest: trial {best.number + 1}, {_shown(best.overrides)}")
    click.echo(f"as a preset, for --preset: {out / BEST}")


def _shown(overrides: dict[str, Any]) -> str:
    values = ((n, f"{v:.3g}" if isinstance(v, float) else str(v)) for n, v in overrides.items())
    return ", ".join(f"{name} {value}" for name, value in values)
