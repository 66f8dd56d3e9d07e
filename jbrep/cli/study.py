"""Many agents, and what came of them."""

from pathlib import Path

import click

from jbrep.cli.base import RESUMES, echo_paths, example, printable, stoppable


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
    with stoppable(RESUMES):
        crashed = run_study(plan, run, count)
    echo_paths([*_conclude(plan.folder), *write_report(plan.folder)])
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
    echo_paths([*paths, *write_report(folder, out)])


def _conclude(folder: Path) -> list[Path]:
    """Print and write the tables of the runs below a folder."""
    from jbrep.study.heuristics import write_heuristics
    from jbrep.study.results import as_text, read_results, write_results

    results = read_results(folder)
    for line in as_text(results).splitlines():
        click.echo(printable(line))
    tasks = {run.task for run in results.runs}
    return [*write_results(results, folder), write_heuristics(tasks, folder)]
