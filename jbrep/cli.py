"""The command line: parse, call one function, print."""

import math
from pathlib import Path

import click

from jbrep.errors import InputError

_LEARN = {"torch", "stable_baselines3", "safetensors", "rich"}


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
            if error.name not in _LEARN:
                raise
            raise _Mistake(f"this needs {error.name}: pip install 'jbrep[learn]'") from None


def _example(text: str) -> str:
    return f"Example: {text}"


@click.group(cls=_Cli, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="jbrep")
def main() -> None:
    """Reduced-order representations of the Jitterbug, and what they do to learning."""


@main.command(epilog=_example("jbrep collect --task face_direction --steps 20k --out data/face"))
@click.option("--task", required=True, help="A Jitterbug task, such as face_direction.")
@click.option("--steps", required=True, type=_COUNT, help="Control steps, in whole episodes.")
@click.option("--seed", default=0, show_default=True, help="Of every start and action.")
@click.option("--threads", type=int, help="Threads to simulate on; all cores if not given.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new folder.")
def collect(task: str, steps: int, seed: int, threads: int | None, out: Path) -> None:
    """Collect the states that a uniform random policy visits."""
    from jbrep.collect import Collection
    from jbrep.collect import collect as run

    collection = Collection(task, steps, seed)
    run(collection, out, threads)
    click.echo(f"{collection.episodes} episodes of {task} in {out}")


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
