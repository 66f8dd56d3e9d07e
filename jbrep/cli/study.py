"""Studies: many agents, and what the statistics say of them."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from jbrep import api
from jbrep.cli.base import RESUMES, command, say, say_json, tell
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError, choose
from jbrep.parameters import AsJson, Backend, Workers, find_study
from jbrep.text import Table, counted, duration, terminal_width

if TYPE_CHECKING:
    from jbrep.reporting.report import Report
    from jbrep.reporting.views import Cells
    from jbrep.stats.rules import Planned
    from jbrep.studies.forecast import Forecast

_WATCH_EVERY = 30.0  # seconds


@command("study demo --out runs/demo")
def study(
    study: Path,
    /,
    *,
    out: Path | None = None,
    workers: Workers = None,
    backend: Backend = "local",
    dry_run: bool = False,
    register: bool = False,
) -> bool:
    """Train a grid of agents, and test the claims of a study.

    STUDY is a TOML file of tasks, algorithms, representations and seeds, or demo, which ships.
    Tasks are the Jitterbug's, by their names, and any environments, by their Gymnasium ids.
    One with claims must be registered first: run --register, and commit the file that it writes.
    Stopped or killed, the same command resumes the study; runs that have ended are kept.

    Args:
        out: a folder; by default runs/NAME of the STUDY.
        dry_run: list the runs and estimate the time.
        register: write down the plan beside STUDY, with the hashes of what is there and the code's
            version, before the first run.
    """
    from jbrep.records.document import read_toml

    if dry_run and register:
        raise InputError("choose --dry-run or --register")
    if register and (workers or backend != "local"):
        raise InputError("--register runs nothing: leave out --workers and --backend")
    file = find_study(study)
    if register and file != study:
        raise InputError(
            f"--register writes beside a study's file, and {study} ships: copy {file} and name that"
        )
    read_toml(file)
    from jbrep.studies.runner import BACKENDS  # imports torch

    choose(backend, BACKENDS, "backend")
    if dry_run and backend != "local":
        raise InputError("--dry-run forecasts this machine alone: leave out --backend")
    folder = out or Path("runs") / file.stem
    if dry_run or register:
        _announce(file, folder, dry_run, workers)
        return False
    with stoppable(RESUMES):
        made = api.study(file, folder, workers=workers, backend=backend)
    _show(made)
    return bool(made.tables.raw.record.missing)


def _announce(path: Path, folder: Path, dry_run: bool, workers: int | None) -> None:
    """Say what a study is going to do, or write it down before the first run."""
    from jbrep.studies import Plan, read_study, register_study
    from jbrep.studies.forecast import forecast
    from jbrep.studies.plan import registration_in

    plan = Plan(read_study(path), folder, path)
    expected = forecast(plan, workers) if dry_run else None
    for notice in plan.study.notices:
        tell(notice, err=True)
    if expected:
        return say(_forecast_text(expected, plan.study.planned, terminal_width()))
    registered = register_study(plan)
    found = registration_in(registered)
    say(f"registered on {found.date} (SHA-256 {found.sha256})")
    if plan.in_git:
        tell(f"Commit {registered.name} first: until then the study is refused.", err=True)
    return say(f"\n{registered}")


def _forecast_text(forecast: "Forecast", planned: "Planned", width: int) -> str:
    """The runs to go, their time, and what could be found of the study's claims."""
    from jbrep.reporting.views import in_text, probability, say
    from jbrep.stats.power import BETTER_BY, EARLIER_BY, SDS

    to_go: dict[str, list[float]] = {}
    for cell, seconds in forecast.runs:
        to_go.setdefault(cell.label, []).append(seconds)
    runs: Cells = {
        "agents": lambda item: item[0],
        "runs": lambda item: str(len(item[1])),
        "time of each": lambda item: duration(max(item[1])),
    }
    prospects: Cells = {
        "on": lambda each: each.where,
        "claim": lambda each: str(each.claim),
        "units": lambda each: str(each.units),
        "level": lambda each: probability(each.level),
        "least p": lambda each: probability(each.least_p),
        "power": lambda each: ", ".join(f"{100 * power:.0f} %" for power in each.power),
        "unseen": lambda each: f"{100 * each.unseen:.0f} %",
    }
    parts: list[str | Table] = [Table.of("", to_go.items(), runs)] if to_go else []
    on_one_core = sum(seconds for _, seconds in forecast.runs)
    parts.append(say("forecast", forecast, duration(on_one_core), duration(forecast.elapsed)))
    if forecast.prospects:
        count = len(planned.rules.chains) * len(planned.groups)
        parts.append(Table.of("", forecast.prospects, prospects))
        parts.append(say("rules", count, planned.rules.error, len(planned.seeds)))
        parts.append(say("power", SDS, BETTER_BY, EARLIER_BY))
    return "\n\n".join(in_text(part, width) for part in parts)


@command("report runs/demo")
def report(
    folder: Path,
    /,
    *,
    everything: Annotated[bool, Meta(extra={"option": "all"})] = False,
    watch: bool = False,
    as_json: AsJson = False,
    **options: Annotated[Any, api.report],
) -> None:
    """Summarise what a study found, and write a page of it.

    FOLDER holds a study, finished or not, or any runs. Where there are no runs, as in
    results/confirm, the report is made from the tables alone.

    Args:
        everything: print every table; the page has them.
        watch: write it again every 30 s until all runs have ended; the page reloads itself.
    """
    made = api.report(folder, **options)
    while watch and (left := len(made.findings.missing)):
        tell(f"{counted(left, 'run')} to go: {made.page}", err=True)
        time.sleep(_WATCH_EVERY)
        made = api.report(folder, **options)
    _show(made, everything, as_json)


def _show(made: "Report", everything: bool = False, as_json: bool = False) -> None:
    from jbrep.reporting.report import results_text

    if not as_json:
        say(results_text(made.findings, terminal_width(), everything))
    for line in made.notes:
        say(line, err=True)
    if as_json:
        return say_json(made.findings.as_json())
    beside = ", ".join(path.name for path in made.paths if path != made.page)
    more = "" if everything else " --all prints every table."
    say(f"\n{made.page}")
    return tell(f"Beside it: {beside}.{more}")
