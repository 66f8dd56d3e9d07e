"""Training one agent, and a search for an algorithm's settings."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, PATH, POSITIVE, RESUMES, with_options
from jbrep.cli.completion import complete_encoder
from jbrep.cli.environment import (
    domain_option,
    environment_options,
    needed_task,
    needed_task_option,
    parse_arguments,
    retries_option,
)
from jbrep.cli.options import record_options
from jbrep.cli.output import say, tell
from jbrep.cli.signals import stop_signals, stoppable
from jbrep.errors import choose
from jbrep.records.record import converted
from jbrep.rl.settings import CLASSES, Seed, TrainingSettings
from jbrep.text import returns_text, rounded

_BESIDE = 10  # episodes of policies that don't learn
learner_options = with_options(  # which `checked` reads
    click.option(
        "--encoder",
        shell_complete=complete_encoder,
        default="full",
        show_default=True,
        help="A file, a shipped encoder's name, or code as module:Class, which is run; full is "
        "the whole observation, scaled alike.",
    ),
    click.option(
        "--algorithm", default="sac", show_default=True, help=f"One of {', '.join(CLASSES)}."
    ),
    click.option(
        "--preset",
        default="",
        help="Its settings: paper, modern, wide, or a TOML file with a table for each algorithm.  "
        "[default: wide, or modern where that has none]",
    ),
    click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="NAME=VALUE",
        help="A setting other than the preset's, by stable-baselines3's name, such as "
        "learning_rate=3e-4, net_arch=[64,64] or learning_rate=linear:3e-4; may be repeated.",
    ),
    click.option(
        "--normalize",
        is_flag=True,
        help="Normalise what the agent sees by its running mean and variance.",
    ),
)


def checked(options: dict[str, Any]) -> dict[str, Any]:
    """The options of a command as `jbrep.train` takes them; code that they name is imported.

    Args:
        options: of `needed_task_option`, `environment_options`, `learner_options` and
            `record_options`.
    """
    from jbrep.encoders.shipped import check_found
    from jbrep.envs.names import import_code
    from jbrep.rl.files import read_finished
    from jbrep.rl.presets import get_preset, usual_preset

    algorithm = options["algorithm"]
    choose(algorithm, CLASSES, "algorithm")
    preset = options["preset"] or usual_preset(algorithm)
    if not preset.endswith(".toml"):
        get_preset(preset, algorithm)
    converted(options["seed"], Seed, "seed")
    overrides = parse_arguments(options["overrides"], "--set")
    if options.pop("normalize"):
        overrides["normalize"] = True
    if begin_from := options.get("begin_from"):
        read_finished(Path(begin_from))
    task = needed_task(options)
    import_code(options["encoder"])
    check_found(options["encoder"], task)
    return {**options, "task": task, "overrides": overrides}


@click.command(
    epilog="Example: jbrep rl --task face_direction --algorithm ddpg --encoder dae-8 --out runs/a"
)
@needed_task_option
@click.option("--out", required=True, type=PATH, help="A folder for this run.")
@learner_options
@click.option("--seed", default=0, show_default=True, type=COUNT, help="Of agent and episodes.")
@record_options(TrainingSettings)
@click.option(
    "--threads",
    type=click.IntRange(1, 4096),
    help="Threads of a batch, as many as cores by default. 1 is one instance of another "
    "environment, as of a robot that exists once: num_envs is 1, in the preset modern unless one "
    "is named, and evaluations wait for the end of an episode.",
)
@retries_option
@click.option(
    "--from",
    "begin_from",
    default="",
    metavar="RUN",
    help="Begin with the final weights of a finished run of the same algorithm and sizes, such as "
    "one on another body; optimisers and SAC's entropy coefficient start anew.",
)
@click.option(
    "--wandb",
    metavar="PROJECT",
    help="Log to Weights & Biases, too; WANDB_MODE=offline keeps it in the folder.",
)
@domain_option
@environment_options
@click.pass_context
def rl(context: click.Context, /, out: Path, **options: Any) -> None:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent. A checkpoint is written every
    minute, and on Ctrl-C before the command ends (td3 takes seconds to get there). The same command
    resumes from it, to the same result. The last one stays: with more --steps the same command goes
    on from there, to the result that it would have had with as many from the start.
    """
    with stop_signals() as received:
        options = checked(options)
        from jbrep import api
        from jbrep.encoders.shipped import source_of
        from jbrep.envs.infos import shares_text
        from jbrep.envs.make import is_one_robot
        from jbrep.play.references import beside
        from jbrep.rl.files import EVALUATIONS, last_infos, read_evaluations, read_infos

        task = options["task"]
        with _told_when_stopped(received, f"; {RESUMES}" if task.reproducible else ""):
            agent = api.train(out=out, stop=lambda: bool(received), **options)
    if agent.record.reason is not None:
        click.echo(f"the run failed: {agent.record.reason}; {_left(out)}", err=True)
        context.exit(1)
    returns = agent.returns
    name = agent.record.settings.representation
    tell(f"returns on {name} at the end: {returns_text(returns)}")
    if told := shares_text(last_infos(read_infos(out), read_evaluations(out))):
        tell(told)
    alone = is_one_robot(task, options["threads"])
    with stoppable("the run itself is finished"):
        if not alone and (compared := beside(task, returns, min(len(returns), _BESIDE))):
            tell(str(compared))
    source = source_of(options["encoder"], task)
    tell(f"encoder: {source}; all evaluations:")
    say(str(out / EVALUATIONS))


def _left(folder: Path) -> str:
    """What a run that failed has left."""
    from jbrep.rl.files import FAILED, RUN, read_run

    left = read_run(folder)
    if left.status == FAILED:
        return f"see {folder / RUN}"
    return f"{folder} still has what its first {left.steps:,} steps made, and its last checkpoint"


@click.command(
    epilog="Example: jbrep tune --task face_direction --algorithm sac --preset modern --trials 20 "
    "--steps 20k --out runs/tune"
)
@needed_task_option
@learner_options
@click.option("--trials", default=20, show_default=True, type=POSITIVE, help="Trials in all.")
@click.option("--seeds", default=1, show_default=True, type=POSITIVE, help="Runs of each trial.")
@click.option("--seed", default=0, show_default=True, type=COUNT, help="Of the search and runs.")
@record_options(
    TrainingSettings, "steps", "evaluation_episodes", steps=100_000, evaluation_episodes=10
)
@click.option("--out", required=True, type=PATH, help="A folder for this search.")
@domain_option
@environment_options
def tune(out: Path, trials: int, seeds: int, **options: Any) -> None:
    """Search for an algorithm's settings with Optuna.

    Learning rate, batch size, discount, layers and others of the algorithm are searched, but for
    those that --set gives. The score of a trial is the mean return of its runs' last evaluations.
    The best settings are written as a preset file, for --preset. The same command resumes a search;
    --trials may grow.
    """
    with stop_signals() as received:
        steps, episodes = options["steps"], options["evaluation_episodes"]
        options = checked(options)
        from jbrep.rl import Run  # imports torch, after all words are known
        from jbrep.rl.tune import BEST, Trial
        from jbrep.rl.tune import tune as search

        def show(trial: Trial) -> None:
            score = "failed" if trial.value is None else rounded(trial.value)[0]
            click.echo(f"trial {trial.number + 1} of {trials}: {score}  {_shown(trial.overrides)}")

        run = Run.of(**options, evaluate_every=steps, final_episodes=episodes)
        with _told_when_stopped(received, f" of a trial; {RESUMES}"):
            best = search(run, trials, seeds, out, show, stop=lambda: bool(received))
    click.echo(f"\nbest: trial {best.number + 1}, {_shown(best.overrides)}")
    click.echo(f"as a preset, for --preset: {out / BEST}")


@contextmanager
def _told_when_stopped(received: list[int], more: str) -> Iterator[None]:
    """End the command once a signal has stopped what it trains, as a shell reports it."""
    from jbrep.rl import StoppedError  # imports torch

    try:
        yield
    except StoppedError as error:
        click.echo(f"{error}{more}", err=True)
        raise SystemExit(128 + received[0]) from None


def _shown(overrides: dict[str, Any]) -> str:
    values = ((n, f"{v:.3g}" if isinstance(v, float) else str(v)) for n, v in overrides.items())
    return ", ".join(f"{name} {value}" for name, value in values)
