"""Training one agent, and a search for an algorithm's settings."""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import (
    COUNT,
    PATH,
    POSITIVE,
    RESUMES,
    STOP_SIGNALS,
    on_stop,
    say,
    stoppable,
    with_options,
)
from jbrep.cli.completion import complete_encoder
from jbrep.cli.environment import needed_task, parse_arguments, retries_option, task_options
from jbrep.cli.options import record_options
from jbrep.errors import choose
from jbrep.records.record import converted
from jbrep.rl.settings import CLASSES, MODERN, Seed, TrainingSettings
from jbrep.text import interval_of, rounded, sparkline

if TYPE_CHECKING:
    from stable_baselines3.common.logger import KVWriter

    from jbrep.envs.task import Task
    from jbrep.rl import Run
    from jbrep.rl.job import Job

_STOPPING = b"\nstopping: writing a checkpoint, within seconds; Ctrl-C again ends at once\n"
_LINE = "{desc}: {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"  # on a terminal
_BESIDE = 10  # episodes of policies that don't learn
_NAME, _CURVE = 16, 10  # letters and blocks in it, at most
_NOT_REPRODUCIBLE = (
    "{} is not reproducible: the same seed gives other numbers the next time, and a run that is "
    "stopped can't be resumed"
)
learner_options = with_options(  # which `given_run` reads
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
    click.option(
        "--encoder",
        shell_complete=complete_encoder,
        default="full",
        show_default=True,
        help="A file, a shipped encoder's name, or code as module:Class, which is run; full is "
        "the whole observation, scaled alike.",
    ),
)


def given_run(options: dict[str, Any], threads: int | None = None, **others: Any) -> "Run":
    """The run that the options of a command say; code that they name is imported.

    Args:
        options: of `task_options`, `learner_options` and `record_options`.
        threads: 1 is one lane of an environment that isn't a batch.
        others: fields of a run.

    Raises:
        InputError: --set isn't NAME=VALUE, or names a setting again; or as `Run.of`.
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
    overrides = parse_arguments(options.pop("overrides"), "--set")
    if options.pop("normalize"):
        overrides["normalize"] = True
    if begin_from := options.get("begin_from"):
        read_finished(Path(begin_from))
    task = needed_task(options)
    import_code(options["encoder"])
    check_found(options["encoder"], task)
    if is_one := is_one_robot(task, threads):
        options["preset"] = options["preset"] or MODERN
    from jbrep.rl import Run  # imports torch, after all words are known to be right

    run = Run.of(task, overrides=overrides, **options, **others)
    if is_one and run.learner.hyperparameters.num_envs > 1:
        return run.replace(learner=run.learner.overridden({"num_envs": 1}))
    return run


def is_one_robot(task: "Task", threads: int | None) -> bool:
    """Whether a command is to have one instance of an environment."""
    from jbrep.envs.make import is_batched

    return threads == 1 and not is_batched(task)


@click.command(
    epilog="Example: jbrep rl --task face_direction --algorithm ddpg --encoder dae-8 --out runs/a"
)
@task_options
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
    "project",
    metavar="PROJECT",
    help="Log to Weights & Biases, too; WANDB_MODE=offline keeps it in the folder.",
)
@click.option("--out", required=True, type=PATH, help="A folder for this run.")
@click.pass_context
def rl(
    context: click.Context,
    /,
    out: Path,
    project: str | None,
    threads: int | None,
    retries: int,
    **options: Any,
) -> None:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent. A checkpoint is written every
    minute, and on Ctrl-C before the command ends (td3 takes seconds to get there). The same command
    resumes from it, to the same result. The last one stays: with more --steps the same command goes
    on from there, to the result that it would have had with as many from the start.
    """
    with stop_signals() as received:
        run = given_run(options, threads)
        from joblib import cpu_count

        from jbrep.encoders.shipped import source_of
        from jbrep.envs.infos import shares_text
        from jbrep.rl import StoppedError
        from jbrep.rl.files import (
            EVALUATIONS,
            RUN,
            last_infos,
            last_returns,
            read_evaluations,
            read_infos,
        )
        from jbrep.rl.job import Job, Session
        from jbrep.rl.trainers import train_jobs
        from jbrep.study.single import beside

        is_one = is_one_robot(run.task, threads)
        job = Job(run, out, threads or cpu_count(), retries, is_one)
        source = source_of(run.encoder, run.task)
        if not run.task.reproducible:
            click.echo(_NOT_REPRODUCIBLE.format(run.task.name), err=True)
        try:
            with closing(_Bar(run.steps, f"{run.learner.algorithm} on {source}")) as bar:
                writers = _writers(project, job)
                session = Session(
                    bar.show, stop=lambda: bool(received), writers=writers, keeps=True
                )
                ((_, result),) = train_jobs([job], session)
        except StoppedError as error:
            resumes = f"; {RESUMES}" if run.task.reproducible else ""
            click.echo(f"{error}{resumes}", err=True)
            context.exit(128 + received[0])  # as a shell reports a command that a signal ended
    if result.reason is not None:
        click.echo(f"the run failed: {result.reason}; see {out / RUN}", err=True)
        context.exit(1)
    evaluations = read_evaluations(out)
    last = last_returns(evaluations)
    name = result.settings.representation
    click.echo(
        f"returns on {name} at the end: {interval_of(last)}, median [10 %, 90 %] of {len(last)} "
        "episodes"
    )
    if told := shares_text(last_infos(read_infos(out), evaluations)):
        say(told)
    with stoppable("the run itself is finished"):
        if compared := beside(run.task, last, min(len(last), _BESIDE)):
            say(str(compared))
    say(f"encoder: {source}; all evaluations: {out / EVALUATIONS}")


def _writers(project: str | None, job: "Job") -> "list[KVWriter]":
    """What logs to a project of Weights & Biases, if there is one."""
    if project is None:
        return []
    from jbrep.rl.tracker import Tracker

    return [Tracker(project, job.folder, job.settings)]


class _Bar:
    """A line of progress, from the step on at which the run starts or resumes.

    On a terminal it has a curve of the evaluations' mean returns, and fits 80 columns.
    """

    def __init__(self, steps: int, name: str):
        self._steps = steps
        self._name = name if len(name) <= _NAME else f"{name[: _NAME - 3]}..."
        self._progress: Any = None

    def show(self, job: "Job", step: int, mean: float | None) -> None:
        """Show the steps so far and the mean returns of the evaluations.

        The final evaluation can take minutes: all steps are told before it, and after it again.
        """
        from jbrep.progress import Progress

        if self._progress is None:
            self._progress = Progress(
                total=self._steps,
                initial=step,
                desc=self._name,
                unit="",
                unit_scale=True,
                delay=0.5,
                bar_format=_LINE,
            )
        is_final = self._progress.n < self._steps <= step
        self._progress.update(step - self._progress.n)
        shown = "final ones under way" if is_final else self._course(job.history.means)
        self._progress.set_postfix(returns=shown, refresh=is_final)

    def _course(self, means: Sequence[float]) -> str:
        """The last mean return, after a curve of all where there are Unicode's blocks."""
        if not means:
            return "-"
        curve = "" if self._progress.ascii else sparkline(means, _CURVE)
        return f"{curve} {rounded(means[-1])[0]}".strip()

    def close(self) -> None:
        """End the line."""
        if self._progress is not None:
            self._progress.close()


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """The signals received so far, Ctrl-C or SIGTERM; the second ends the process at once."""
    received: list[int] = []

    def receive(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for each in STOP_SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        if sys.stderr is not None:  # written directly: Python's streams may be in use right now
            with suppress(OSError, ValueError):
                os.write(sys.stderr.fileno(), _STOPPING)

    with on_stop(receive):
        yield received


@click.command(
    epilog="Example: jbrep tune --task face_direction --algorithm sac --preset modern --trials 20 "
    "--steps 20k --out runs/tune"
)
@task_options
@learner_options
@click.option("--trials", default=20, show_default=True, type=POSITIVE, help="In all.")
@click.option("--seeds", default=1, show_default=True, type=POSITIVE, help="Runs of each trial.")
@click.option("--seed", default=0, show_default=True, type=COUNT, help="Of the search and runs.")
@record_options(
    TrainingSettings, "steps", "evaluation_episodes", steps=20_000, evaluation_episodes=10
)
@click.option("--out", required=True, type=PATH, help="A folder for this search.")
@click.pass_context
def tune(context: click.Context, /, out: Path, trials: int, seeds: int, **options: Any) -> None:
    """Search for an algorithm's settings with Optuna.

    Learning rate, batch size, discount, layers and others of the algorithm are searched, but for
    those that --set gives. The score of a trial is the mean return of its runs' last evaluations.
    The best settings are written as a preset file, for --preset. The same command resumes a search;
    --trials may grow.
    """
    with stop_signals() as received:
        steps, episodes = options["steps"], options["evaluation_episodes"]
        run = given_run(options, evaluate_every=steps, final_episodes=episodes)
        from jbrep.rl import StoppedError
        from jbrep.rl.tune import BEST, Trial
        from jbrep.rl.tune import tune as search

        def show(trial: Trial) -> None:
            score = "failed" if trial.value is None else rounded(trial.value)[0]
            click.echo(f"trial {trial.number + 1} of {trials}: {score}  {_shown(trial.overrides)}")

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
