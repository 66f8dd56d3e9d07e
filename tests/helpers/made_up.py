"""Studies whose truth is known: their runs are made up, all else is real."""

from contextlib import contextmanager

import matplotlib as mpl
import numpy as np
import pytest

from jbrep.encoders import find, save
from jbrep.records.tables import write_rows
from jbrep.reporting.figures.panels import PAPER
from jbrep.reporting.findings import Findings, RunFound, groups_of
from jbrep.rl.files import ENCODER, EVALUATIONS, FAILED, FINISHED, RUN, Evaluation, RunRecord
from jbrep.rl.training import packages
from jbrep.stats.analysis import to_plain
from jbrep.studies.config import as_study
from jbrep.studies.plan import Plan

COMMITS = {"jbrep": "1" * 40}
VERSIONS = packages()
STILL = 250
# what runs of each representation end with on average, with what SD, and when they come to half
TRUTH = {"full": (850, 25, 5000), "dae-8": (848, 5, 3500), "pca-8": (500, 40, 6000)}
SEEDS = 16
STUDY = as_study(
    {
        "tasks": ["face_direction", "move_in_direction"],
        "algorithms": ["sac-paper"],
        "representations": list(TRUTH),
        "seeds": SEEDS,
        "steps": 10_000,
        "evaluate_every": 1000,
        "evaluation_episodes": 2,
        "final_episodes": 5,
        "verdicts": {
            "claims": [
                *(f"dae-8 {claim} than full" for claim in ("not worse", "less variable", "faster")),
                "pca-8 not worse than full",
            ],
            "margin": 0.25,
        },
    }
)


def found_of(analysis, runs=(), in_training=None, **changes):
    """The findings of an analysis, with nothing of how the runs were made."""
    lists = ("own_encoders", "left_out", "not_played", "diagnostics", "versions", "processors")
    about = {name: [] for name in (*lists, "encoders", "imports")}
    about |= {"name": "x", "title": "x", "baseline": "full", "top": "", "error": 0.05}
    about |= {"is_study": False, "registration": None, "comparisons": 0, "planned_seeds": 0}
    about |= {"scaling": None, "study": None, "missing": {}, "settings": {}}
    groups = groups_of(analysis, in_training=in_training or {})
    agents = [each for group in groups for each in group.agents]
    told = {
        "tasks": [*dict.fromkeys(group.task for group in groups)],
        "algorithms": [*dict.fromkeys(group.algorithm for group in groups)],
        "representations": [*dict.fromkeys(each.representation for each in agents)],
        "verdicts": to_plain(analysis.verdicts),
        "aggregates": to_plain(analysis.aggregates),
    }
    ended = [
        RunFound(
            **{"label": f"{run.task}/{run.algorithm}/{run.representation}", "seed": run.seed},
            **{"status": "finished", "reason": None, "steps": 1, "minutes": 1.0, "shares": {}},
            curve=[*zip(run.steps.tolist(), run.returns.mean(axis=1).tolist(), strict=True)],
            returns=run.returns[-1].tolist() if len(run.steps) else [],
        )
        for run in runs
    ]
    return Findings(**{**about, **told, "groups": groups, "runs": ended, **changes})


def drawn(plot):
    with mpl.rc_context(PAPER):
        return plot.draw(plot.rows)


def make_runs(plan, seeds):
    """Runs as jbrep rl leaves them, of those seeds."""
    for cell in plan.cells:
        if cell.seed in seeds and cell in plan.unfinished:
            _make_run(plan, cell)


def _make_run(plan, cell):
    folder, run, name = plan.folder_of(cell), plan.run(cell), cell.representation.name
    folder.mkdir(parents=True)
    encoder = find(run.encoder, run.task)
    settings = run.settings(encoder)
    save(encoder, folder / ENCODER)
    random = np.random.default_rng([cell.seed, len(cell.task), *name.encode()])
    mean, spread, time = TRUTH[name]
    end, middle = random.normal(mean, spread), random.normal(time, 8 * spread)
    rows = []
    for step in range(0, plan.study.steps + 1, plan.study.evaluate_every):
        level = STILL + (end - STILL) / (1 + np.exp((middle - step) / 700))
        is_last = step == plan.study.steps
        episodes = settings.final_episodes if is_last else settings.evaluation_episodes
        returns = level + random.normal(0, 0.5, episodes)
        rows += [Evaluation(step, i, float(each)) for i, each in enumerate(returns.clip(0, 1000))]
    tables = {EVALUATIONS: write_rows(folder / EVALUATIONS, rows, Evaluation)}
    write_record(folder, run, tables=tables)


@contextmanager
def of_a_commit():
    """Code and registrations are of a commit in here, also where a contributor has changed some."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Plan, "in_git", True)
        for module in ("jbrep.studies.plan", "jbrep.rl.training"):
            patch.setattr(f"{module}.commits", lambda: COMMITS)
        yield


def write_record(folder, run, reason=None, **changes):
    """The run.json of a run that has ended as planned, or failed for a reason."""
    encoder = find(run.encoder, run.task)
    facts = {"latent_size": encoder.latent_size, "steps": run.steps, "seconds": 60.0}
    facts |= {"versions": VERSIONS, "commits": COMMITS, "cpu": "a processor"}
    facts["tables"] = {EVALUATIONS: "0" * 64}
    RunRecord(
        status=FINISHED if reason is None else FAILED,
        reason=reason,
        settings=run.settings(encoder),
        policy_sha256="0" * 64 if reason is None else None,
        **{**facts, **changes},
    ).write(folder / RUN)


def reached(observation, action):
    """A reward of the arm of examples/robots for where its finger is in the world, (n,)."""
    return observation[:, 2]
