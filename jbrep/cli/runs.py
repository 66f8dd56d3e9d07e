"""Agents, and what came of them."""

from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, GOES_ON, POSITIVE, example, printable, stoppable


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
    from tqdm import tqdm

    from jbrep.rl import Run, train
    from jbrep.rl.files import EVALUATIONS, read_evaluations

    run = Run(**settings)
    run.check()
    with (
        stoppable(GOES_ON),
        tqdm(
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
    _tell(write(behaviour_plots(found.name, behaviours, SPEEDS, yaw), out))


@click.command(epilog=example("jbrep study studies/smoke.toml --out runs/smoke"))
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="A folder; runs/NAME if not given.")
@click.option(
    "--workers", type=click.IntRange(1, 1024), help="Runs at once; one for each core if not given."
)
@click.option(
    "--backend",
    default="joblib",
    show_default=True,
    help="joblib, on this machine, or ray, on the cluster that RAY_ADDRESS names.",
)
@click.option("--dry-run", is_flag=True, help="List the runs and estimate the time.")
@click.pass_context
def study(
    context: click.Context,
    /,
    study: Path,
    out: Path | None,
    workers: int | None,
    backend: str,
    dry_run: bool,
) -> None:
    """Train a grid of agents, and judge the paper's claims.

    STUDY is a TOML file of tasks, algorithms, representations and seeds, such as those in studies/.
    Data sets and encoders are made first. What is finished is never run again: stopped or killed,
    the same command goes on.
    """
    from joblib import cpu_count

    from jbrep.report import write_report
    from jbrep.study.config import read_study
    from jbrep.study.plan import Plan
    from jbrep.study.runner import get_backend
    from jbrep.study.study import dry_run as dry_run_text
    from jbrep.study.study import run_study

    plan = Plan(read_study(study), out or Path("runs") / study.stem)
    run, count = get_backend(backend), workers or cpu_count()
    if dry_run:
        click.echo(dry_run_text(plan, count))
        return
    with stoppable(GOES_ON):
        crashed = run_study(plan, run, count)
    _tell([*_conclude(plan.folder), *write_report(plan.folder)])
    if crashed:
        click.echo(f"{crashed} runs crashed: the same command tries them again", err=True)
        context.exit(1)


@click.command(epilog=example("jbrep report runs/smoke"))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="A folder for it; the study's own if not given."
)
def report(folder: Path, out: Path | None) -> None:
    """Show what a study says, as a page, tables and figures.

    FOLDER is of a study, finished or not, or any with runs below it. Where there are no runs, as
    in results/desk, the report is made from the tables alone.
    """
    from jbrep.report import write_report
    from jbrep.study.results import has_runs

    paths = _conclude(folder) if has_runs(folder) else []
    _tell([*paths, *write_report(folder, out)])


def _conclude(folder: Path) -> list[Path]:
    """Print and write the tables of the runs below a folder."""
    from jbrep.study.heuristics import write_heuristics
    from jbrep.study.results import as_text, read_results, write_results

    results = read_results(folder)
    for line in as_text(results).splitlines():
        click.echo(printable(line))
    tasks = {run.task for run in results.runs}
    return [*write_results(results, folder), write_heuristics(tasks, folder)]


def _tell(paths: list[Path]) -> None:
    click.echo("\n" + "\n".join(printable(str(path)) for path in paths))
