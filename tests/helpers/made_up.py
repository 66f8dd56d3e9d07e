"""A registered study whose truth is known: its runs are made up, all else is real."""

import numpy as np

from jbrep.encoders import find, save
from jbrep.rl.files import ENCODER, Evaluation, write_rows, write_run
from jbrep.rl.job import packages
from jbrep.study.config import as_study

STILL = 250
# what runs of each representation end with on average, with what SD, and when they come to half
TRUTH = {"full": (850, 25, 5000), "dae-8": (848, 5, 3500), "pca-8": (500, 40, 6000)}
SEEDS = 16
STUDY = as_study(
    {
        "tasks": ["face_direction", "move_in_direction"],
        "algorithms": ["sac"],
        "representations": list(TRUTH),
        "seeds": SEEDS,
        "steps": 10_000,
        "evaluate_every": 1000,
        "evaluation_episodes": 2,
        "final_episodes": 5,
        "verdicts": {
            "primary": ["face_direction/sac/dae-8", "face_direction/sac/pca-8"],
            "failing": 0.25,
        },
    }
)


def make_runs(plan, seeds):
    """Runs as jbrep rl leaves them, of those seeds."""
    for cell in plan.cells:
        if cell.seed in seeds and not plan.has_ended(cell):
            _make_run(plan, cell)


def _make_run(plan, cell):
    folder, run, name = plan.folder_of(cell), plan.run(cell), cell.representation.name
    folder.mkdir(parents=True)
    encoder = find(run.encoder, run.task)
    save(encoder, folder / ENCODER)
    random = np.random.default_rng([cell.seed, len(cell.task), *name.encode()])
    mean, spread, time = TRUTH[name]
    end, middle = random.normal(mean, spread), random.normal(time, 8 * spread)
    rows = []
    for step in range(0, plan.study.steps + 1, plan.study.evaluate_every):
        level = STILL + (end - STILL) / (1 + np.exp((middle - step) / 700))
        episodes = run.episodes_at(step)
        returns = level + random.normal(0, 0.5, episodes)
        rows += [Evaluation(step, i, float(each)) for i, each in enumerate(returns.clip(0, 1000))]
    write_rows(folder / "evaluations.csv", rows, Evaluation)
    settings = run.describe(encoder)
    write_run(
        folder,
        {
            **{"status": "finished", "settings": settings, "steps": plan.study.steps},
            **{"seconds": 60.0, "versions": packages(), "cpu": "a processor"},
        },
    )
