"""Search for an algorithm's settings with Optuna: each trial trains an agent.

    python examples/tune/tune.py face_direction --steps 20000 --trials 20 --out runs/tune

The same command goes on with the search, as Optuna keeps it; its dashboard shows search.db.
"""

import argparse
from pathlib import Path

import optuna

import jbrep

given = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
given.add_argument("task")
given.add_argument("--algorithm", default="sac")
given.add_argument("--steps", type=int, default=20_000)
given.add_argument("--trials", type=int, default=20)
given.add_argument("--out", type=Path, default=Path("runs/tune"))


def main(arguments: argparse.Namespace) -> None:
    arguments.out.mkdir(parents=True, exist_ok=True)

    def mean_return(trial: optuna.Trial) -> float:
        settings = {
            "learning_rate": trial.suggest_float("learning_rate", 1e-5, 1e-2, log=True),
            "gamma": trial.suggest_categorical("gamma", [0.9, 0.95, 0.98, 0.99, 0.995]),
            "net_arch": [trial.suggest_categorical("width", [64, 128, 256])] * 2,
        }
        agent = jbrep.train(
            arguments.task,
            arguments.out / f"trial-{trial.number}",
            algorithm=arguments.algorithm,
            preset="modern",
            steps=arguments.steps,
            overrides=settings,
        )
        return float(agent.returns.mean())

    study = optuna.create_study(
        study_name=f"{arguments.algorithm} on {arguments.task}",
        storage=f"sqlite:///{arguments.out / 'search.db'}",
        sampler=optuna.samplers.TPESampler(seed=0),
        direction="maximize",
        load_if_exists=True,
    )
    study.optimize(mean_return, n_trials=max(0, arguments.trials - len(study.trials)))
    print(f"best: trial {study.best_trial.number}, {study.best_value:.4g}, {study.best_params}")


if __name__ == "__main__":
    main(given.parse_args())
