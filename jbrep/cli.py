"""The command line: parse, call one function, print."""

import math
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import click

from jbrep.errors import InputError

_EXTRAS = {  # what a missing package is installed with
    **dict.fromkeys(("torch", "stable_baselines3", "safetensors", "rich"), "learn"),
    **dict.fromkeys(("minari", "pyarrow"), "export"),
}


class _Count(click.ParamType[int]):
    """A whole number as people write it: 5000000, 5_000_000, 5e6, 5M, 5k."""

    name = "number"

    def convert(
        self, value: str | int, param: click.Parameter | None, ctx: click.Context | None
    ) -> int:
        text = str(value).replace("_", "").lower()
        factor = {"k": 1_000, "m": 1_000_000}.get(text[-1:], 1)
        try:
            number = float(text[:-1] if factor > 1 else text) * factor
        except ValueError:
            number = math.nan
        if not number.is_integer():
            self.fail(f"{value!r} is no whole number: write it as 5000000, 5_000_000, 5e6 or 5M")
        return int(number)


_COUNT = _Count()


class _Mistake(click.ClickException):
    exit_code = 2

    def __init__(self, message: str):
        super().__init__(_printable(message))


def _printable(line: str) -> str:
    """One line that can't steer a terminal, whatever a file's name holds."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


@contextmanager
def _stoppable(how_to_go_on: str) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the command between two steps, with a line on how to go on."""
    numbers = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    before = [signal.signal(number, stop) for number in numbers]
    try:
        yield
    except SystemExit:
        click.echo(f"stopped; {how_to_go_on}", err=True)
        raise
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


class _Cli(click.Group):
    """A user's mistake is one line and exit code 2; anything else shows its traceback."""

    def invoke(self, ctx: click.Context) -> None:
        try:
            super().invoke(ctx)
        except InputError as error:
            raise _Mistake(str(error)) from None
        except click.UsageError as error:
            command = error.ctx.command_path if error.ctx else "jbrep"
            raise _Mistake(f"{error.format_message()} See {command} --help.") from None
        except ModuleNotFoundError as error:
            if error.name not in _EXTRAS:
                raise
            extra = _EXTRAS[error.name]
            raise _Mistake(f"this needs {error.name}: pip install 'jbrep[{extra}]'") from None


def _example(text: str) -> str:
    return f"Example: {text}"


@click.group(cls=_Cli, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="jbrep")
def main() -> None:
    """Reduced-order representations of the Jitterbug, and what they do to learning."""


_GOES_ON = "the same command goes on where it stopped"

_threads = click.option(
    "--threads", type=click.IntRange(1, 4096), help="To work on; all cores if not given."
)
_lanes = click.option(
    "--lanes",
    type=click.IntRange(1, 100_000),
    default=100,
    show_default=True,
    help="Robots stepped at once.",
)
_data = click.argument("data", type=click.Path(path_type=Path))


@main.command(epilog=_example("jbrep collect --task face_direction --steps 5M --out data/face"))
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option("--steps", required=True, type=_COUNT, help="Control steps, in whole episodes.")
@click.option("--seed", default=0, show_default=True, help="Root of every episode's seed.")
@click.option(
    "--policy",
    default="uniform",
    show_default=True,
    help="uniform, heuristic, constant:drive=0.5 or ornstein-uhlenbeck:mu=0,theta=0.15,sigma=0.3.",
)
@click.option("--store-state", is_flag=True, help="Keep qpos and qvel, for jbrep data derive.")
@click.option("--shard-episodes", default=100, show_default=True, help="Episodes in a shard.")
@_lanes
@_threads
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A folder.")
def collect(
    task: str,
    steps: int,
    seed: int,
    policy: str,
    store_state: bool,
    shard_episodes: int,
    lanes: int,
    threads: int | None,
    out: Path,
) -> None:
    """Collect the states that a policy visits.

    The same command goes on with what it began; a finished data set is left as it is. Neither
    lanes nor threads change the data.
    """
    from jbrep.collect import collect as run
    from jbrep.dataset.manifest import Settings
    from jbrep.policies import parse_policy, policy_settings

    how = policy_settings(parse_policy(policy))
    settings = Settings(
        task=task,
        policy=how,
        steps=steps,
        seed=seed,
        shard_episodes=shard_episodes,
        store_state=store_state,
    )
    with _stoppable(_GOES_ON):
        _tell(out, run(settings, out, lanes, threads))


def _tell(out: Path, written: Any) -> None:
    """What is in the folder now, and how fast it came there."""
    manifest, rows, seconds = written
    size = sum(entry.bytes for entry in manifest.shards) / 1e6
    total = sum(entry.rows for entry in manifest.shards)
    settings = manifest.settings
    what = f"{settings.episodes:,} episodes of {settings.task}, {total:,} rows, {size:,.1f} MB"
    click.echo(f"{what} in {out}")
    if rows:
        click.echo(f"{rows:,} rows in {seconds:,.0f} s, {rows / seconds:,.0f} a second")
    else:
        click.echo("it was complete already: nothing was done")


@main.group()
def data() -> None:
    """Look at, check, mend, derive and export data sets."""


@data.command(epilog=_example("jbrep data info data/face"))
@_data
def info(data: Path) -> None:
    """Show what a data set holds."""
    from jbrep.dataset import Dataset
    from jbrep.dataset.card import card

    click.echo(card(Dataset(data)))


@data.command(epilog=_example("jbrep data verify data/face --replay 50"))
@_data
@click.option("--replay", default=0, help="Episodes to simulate again and compare bit for bit.")
@_threads
@click.pass_context
def verify(ctx: click.Context, data: Path, replay: int, threads: int | None) -> None:
    """Check every hash, shape, number and range.

    Exit code 1 if anything is wrong, with a line for each problem.
    """
    from jbrep.dataset import Dataset
    from jbrep.dataset.verify import find_problems
    from jbrep.dataset.verify import replay as replay_episodes

    problems = 0
    for problem in find_problems(data):
        click.echo(_printable(problem))
        problems += 1
    if not problems:
        dataset = Dataset(data)
        for problem in replay_episodes(dataset, replay, threads):
            click.echo(_printable(problem))
            problems += 1
    if problems:
        ctx.exit(1)
    manifest = dataset.manifest
    shards = f"{len(manifest.shards)} of {manifest.settings.num_shards} shards"
    click.echo(
        f"{data}: {len(dataset):,} rows in {shards}, every hash, shape, number and range as it "
        "should be"
    )
    if replay:
        click.echo(f"{replay} episodes simulated again: equal in every bit")


@data.command(epilog=_example("jbrep data repair data/face"))
@_data
@_lanes
@_threads
def repair(data: Path, lanes: int, threads: int | None) -> None:
    """Make damaged and missing files again, as they were."""
    from jbrep.repair import repair as run

    with _stoppable(_GOES_ON):
        done = 0
        for line in run(data, lanes, threads):
            click.echo(_printable(line))
            done += 1
    if not done:
        click.echo(f"{data} is whole: nothing to repair")


@data.command(
    epilog=_example("jbrep data derive data/face --task move_in_direction --out data/move")
)
@_data
@click.option("--task", required=True, help="The task to observe and reward.")
@click.option("--store-state", is_flag=True, help="Keep qpos and qvel.")
@_threads
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A folder.")
def derive(data: Path, task: str, store_state: bool, threads: int | None, out: Path) -> None:
    """Make another task's data set of the same motion.

    Nothing is simulated again, and it equals collecting that task with the same settings, bit for
    bit. The data set needs its states (collect --store-state) and a policy that doesn't act on
    observations.
    """
    from jbrep.derive import derive as run

    with _stoppable(_GOES_ON):
        _tell(out, run(data, task, out, store_state, threads))


@data.command(epilog=_example("jbrep data export data/face --to parquet --out face.parquet"))
@_data
@click.option("--to", required=True, help="minari, parquet or npz.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new file or folder.")
def export(data: Path, to: str, out: Path) -> None:
    """Write a data set in another tool's format.

    For minari, --out is a folder of Minari data sets, as MINARI_DATASETS_PATH names it.
    """
    from jbrep.dataset import Dataset
    from jbrep.export import export as run

    with _stoppable("nothing is left of it"):
        click.echo(f"open it with {run(Dataset(data), to, out)}")


@main.command(epilog=_example("jbrep train-dae --data data/face --latent 8 --out encoder-8"))
@click.option("--data", required=True, type=click.Path(path_type=Path), help="A data set.")
@click.option("--latent", required=True, type=int, help="Latent size l.")
@click.option("--epochs", default=200, show_default=True, help="Passes over the data.")
@click.option("--batch-size", default=8192, show_default=True, help="Rows in a batch.")
@click.option("--seed", default=0, show_default=True, help="Of weights, order and noise.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The encoder file.")
def train_dae(data: Path, latent: int, epochs: int, batch_size: int, seed: int, out: Path) -> None:
    """Train a denoising autoencoder.

    It sees 80 % of the episodes; its error on the rest is printed.
    """
    from jbrep.dae import Training, train
    from jbrep.dataset import Dataset

    training = Training(latent, epochs, batch_size, seed=seed)
    encoder = train(Dataset(data), training)
    encoder.save(out)
    metrics = encoder.header["metrics"]
    click.echo(
        f"held-out mean squared error {metrics['held_out_mse']:.5f} over "
        f"{metrics['held_out_rows']:,} rows, features scaled to [-1, 1]; encoder in {out}"
    )


@main.command(epilog=_example("jbrep rl --task face_direction --encoder encoder-8 --out runs/a"))
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option("--algorithm", default="sac", show_default=True, help="ddpg, td3, sac, ppo or a2c.")
@click.option("--encoder", help="An encoder file; the full observation if not given.")
@click.option("--steps", default=10_000, show_default=True, type=_COUNT, help="Control steps.")
@click.option("--seed", default=0, show_default=True, help="Of agent and environment.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new folder.")
def rl(task: str, algorithm: str, encoder: str | None, steps: int, seed: int, out: Path) -> None:
    """Train and evaluate one agent.

    It sees the full observation, scaled, or an encoder's latent.
    """
    from jbrep.rl import Run, train

    result = train(Run(task, algorithm, encoder, steps, seed), out)
    returns = ", ".join(f"{r:.0f}" for r in result["returns"])
    click.echo(f"returns on {result['representation']}: {returns}; policy and run.json in {out}")


@main.command(epilog=_example("jbrep report runs"))
@click.argument("folder", type=click.Path(path_type=Path))
def report(folder: Path) -> None:
    """Show the runs below a folder side by side."""
    from jbrep.report import summarise

    click.echo(summarise(folder))
