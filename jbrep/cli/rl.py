"""Training one agent, and a search for an algorithm's settings."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from jbrep import api
from jbrep.cli.base import RESUMES, command, say, tell
from jbrep.cli.signals import stop_signals, stoppable
from jbrep.errors import StoppedError
from jbrep.parameters import NOTHING, Algorithm, DrawnTask, Normalize, Overrides, Preset, Seen
from jbrep.rl.settings import Episodes, Seed
from jbrep.rl.settings import Steps as TrainingSteps
from jbrep.text import returns_text, rounded, terminal_width

_BESIDE = 10  # episodes of policies that don't learn


@command("rl --task face_direction --algorithm ddpg --encoder dae-8 --out runs/a")
def _rl(
    task: DrawnTask,
    out: Path,
    **options: Annotated[Any, api.train],
) -> bool:
    with stop_signals() as received:
        from jbrep.encoders.shipped import source_of
        from jbrep.envs.infos import shares_text
        from jbrep.envs.make import is_one_robot
        from jbrep.play.references import beside
        from jbrep.rl.files import EVALUATIONS, RUN, last_infos, read_evaluations, read_infos

        with _told_when_stopped(received, f"; {RESUMES}" if task.reproducible else ""):
            agent = api.train(task, out, stop=lambda: bool(received), **options)
    if agent.record.reason is not None:
        say(f"the run failed: {agent.record.reason}; see {out / RUN}", err=True)
        return True
    returns = agent.returns
    name = agent.record.settings.representation
    tell(f"returns on {name} at the end: {returns_text(returns)}")
    if told := shares_text(last_infos(read_infos(out), read_evaluations(out))):
        tell(told)
    with stoppable("the run itself is finished"):
        alone = is_one_robot(task, options.get("threads"))
        if not alone and (compared := beside(task, returns, min(len(returns), _BESIDE))):
            tell(str(compared))
    tell(f"encoder: {source_of(options.get('encoder', 'full'), task)}; all evaluations:")
    say(str(out / EVALUATIONS))
    return False


@command("clone --data data/walk --method td3+bc --out runs/clone")
def _clone(out: Path, **options: Annotated[Any, api.clone]) -> None:
    with stoppable(RESUMES):
        agent = api.clone(out=out, **options)
    assert agent.clone
    say(f"{agent.record.settings.name}: {agent.clone.card(terminal_width())}\n{out}")


@command(
    "tune --task face_direction --algorithm sac --preset modern --trials 20 --steps 20k "
    "--out runs/tune"
)
def tune(
    task: DrawnTask,
    out: Path,
    *,
    algorithm: Algorithm = "sac",
    preset: Preset = "",
    encoder: Seen = "full",
    overrides: Overrides = NOTHING,
    normalize: Normalize = False,
    trials: Annotated[int, Meta(ge=1)] = 20,
    seeds: Annotated[int, Meta(ge=1)] = 1,
    seed: Seed = 0,
    steps: TrainingSteps = 100_000,
    evaluation_episodes: Episodes = 10,
) -> None:
    """Search for an algorithm's settings with Optuna.

    Learning rate, batch size, discount, layers and others of the algorithm are searched, but for
    those that --set gives. The score of a trial is the mean return of its runs' last evaluations.
    The best settings are written as a preset file, for `preset`. The same command resumes a search;
    `trials` may grow.

    Args:
        out: a folder for this search.
        trials: how many in all.
        seeds: runs of each trial.
        seed: of the search and runs.
        steps: of each run.
        evaluation_episodes: of a run's evaluation.
    """
    with stop_signals() as received:
        known = api.check_learner(task, algorithm, preset, encoder)
        from jbrep.rl import Run  # imports torch, after all words are known
        from jbrep.rl.tune import BEST, Trial
        from jbrep.rl.tune import tune as search

        def show(trial: Trial) -> None:
            score = "failed" if trial.value is None else rounded(trial.value)[0]
            say(f"trial {trial.number + 1} of {trials}: {score}  {_shown(trial.overrides)}")

        run = Run.of(
            known,
            algorithm,
            preset,
            {**overrides, "normalize": True} if normalize else overrides,
            encoder=encoder,
            seed=seed,
            steps=steps,
            evaluate_every=steps,
            evaluation_episodes=evaluation_episodes,
            final_episodes=evaluation_episodes,
        )
        with _told_when_stopped(received, f" of a trial; {RESUMES}"):
            best = search(run, trials, seeds, out, show, stop=lambda: bool(received))
    say(f"\nbest: trial {best.number + 1}, {_shown(best.overrides)}")
    say(f"as a preset, for --preset: {out / BEST}")


@contextmanager
def _told_when_stopped(received: list[int], more: str) -> Iterator[None]:
    """End the command once a signal has stopped what it trains, as a shell reports it."""
    try:
        yield
    except StoppedError as error:
        say(f"{error}{more}", err=True)
        raise SystemExit(128 + received[0]) from None


def _shown(overrides: Mapping[str, Any]) -> str:
    values = ((n, f"{v:.3g}" if isinstance(v, float) else str(v)) for n, v in overrides.items())
    return ", ".join(f"{name} {value}" for name, value in values)
