"""Making, judging and looking at encoders."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from jbrep.cli.base import COUNT, GOES_ON, example, printable, stoppable
from jbrep.errors import InputError


class _Variadic(click.Command):
    """An option that may come several times takes several values, too: --latent 12 8 4."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        repeatable = {
            name
            for option in self.params
            if isinstance(option, click.Option) and option.multiple
            for name in option.opts
        }
        spread: list[str] = []
        for i, arg in enumerate(args):
            follows = i > 1 and not arg.startswith("-") and not args[i - 1].startswith("-")
            name = next((a for a in reversed(args[:i]) if a.startswith("-")), None)
            spread += [name, arg] if follows and name in repeatable else [arg]
        return super().parse_args(ctx, spread)


_data = click.option(
    "--data", required=True, type=click.Path(path_type=Path), help="A folder of jbrep collect."
)
_out = click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="A folder for the encoder files."
)
_latent = click.option(
    "--latent", type=int, multiple=True, help="Latent sizes l; one, or several: 12 8 4."
)
_noise = click.option(
    "--noise", type=float, help="Standard deviation of the corruption; 0.1 if not given."
)


def _how(command: Callable[..., None]) -> Callable[..., None]:
    """The options of everything that has a network."""
    options = (
        click.option("--architecture", help="paper, which is the default, or deep."),
        click.option("--epochs", type=COUNT, help="Passes over the data; paper 200, deep 12."),
        click.option("--batch-size", type=COUNT, help="Rows in a batch; 8192 if not given."),
        click.option("--learning-rate", type=float, help="Of Adam; paper 5e-4, deep 2e-3."),
        click.option("--seed", type=COUNT, help="Of weights, order and noise; 0 if not given."),
        click.option("--device", default="auto", show_default=True, help="cpu, cuda, or auto."),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.command(
    cls=_Variadic,
    epilog=example("jbrep train-dae --data data/face --latent 12 8 4 --out encoders/face"),
)
@_data
@_latent
@_how
@_noise
@_out
def train_dae(**options: Any) -> None:
    """Train denoising autoencoders.

    On 80 % of the episodes, with the paper's settings unless told otherwise; the error on the rest
    is printed. Ctrl-C keeps the best so far, and the same command goes on.
    """
    _fit("dae", **options)


@click.command(
    cls=_Variadic,
    epilog=example(
        "jbrep train-encoder --kind pca --data data/face --latent 8 --out encoders/face"
    ),
)
@click.option(
    "--kind", required=True, help="identity, pca, random, untrained, ae (no noise) or dae."
)
@_data
@_latent
@_how
@_noise
@_out
def train_encoder(kind: str, **options: Any) -> None:
    """Make encoders to compare with, of any kind.

    The scaled observation itself, principal components, a random projection, an untrained network,
    a plain autoencoder, or a denoising one.
    """
    _fit(kind, **options)


def _fit(
    kind: str, data: Path, latent: tuple[int, ...], out: Path, device: str, **how: Any
) -> None:
    from jbrep.dae.training import Training
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.encoders.file import HELD_OUT_MSE
    from jbrep.methods.fit import Fitter, get_kind

    given = {name: value for name, value in how.items() if value is not None}
    settings = get_kind(kind).settings
    for name in (*given, *(["latent"] if latent else [])):
        if name not in settings:
            raise InputError(f"{kind} takes no --{name.replace('_', '-')}: leave it out")
    if "latent" in settings and not latent:
        raise InputError(f"{kind} needs latent sizes: --latent 12 8 4, say")
    trainings = [Training.of(size, **given) for size in latent or (0,)]
    scaled = ScaledDataset(Dataset(data))
    for name in scaled.constant_features:
        click.echo(f"{name} never varies in the training part: it is scaled to 0", err=True)
    fitter = Fitter(scaled, out, device)
    for training in trainings:  # all that is wrong before the first hour
        fitter.check(kind, training)
    with stoppable(f"{GOES_ON}; what is best so far is in {out}"):
        for training in trainings:
            found = fitter.fit(kind, training)
            error = found.encoder.header["metrics"][HELD_OUT_MSE]
            there = "" if found.is_new else ", complete already"
            click.echo(
                f"{found.encoder.name}: held-out mean squared error {error:.5f}, features scaled "
                f"to [-1, 1]; {found.path}{there}"
            )


@click.command(
    cls=_Variadic,
    epilog=example(
        "jbrep evaluate --encoder dae-8 encoders/face/pca-8.safetensors --data data/face"
    ),
)
@click.option(
    "--encoder", required=True, multiple=True, help="Files, or names that ship; one or several."
)
@_data
@click.option(
    "--out",
    default="evaluation",
    show_default=True,
    type=click.Path(path_type=Path),
    help="A folder for evaluation.json and figures.",
)
def evaluate(encoder: tuple[str, ...], data: Path, out: Path) -> None:
    """Show what encoders lose and keep, side by side.

    On the episodes that training holds out: reconstruction, corruption, the latent's units and
    dimensions, linear probes, nearest neighbours, and the next latent.
    """
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.encoders import find
    from jbrep.encoders.file import SUFFIX
    from jbrep.evaluate.files import EVALUATION, write
    from jbrep.evaluate.summary import evaluation_text
    from jbrep.figures import encoder_plots
    from jbrep.figures import write as write_plots

    scaled = ScaledDataset(Dataset(data))
    found = [find(name, scaled.task.name) for name in encoder]
    names = [each.name for each in found]
    labels = [  # by the path, if more than one has the name
        name if names.count(name) == 1 else given.removesuffix(SUFFIX)
        for name, given in zip(names, encoder, strict=True)
    ]
    with stoppable("the same command starts anew"):
        evaluation = write(dict(zip(labels, found, strict=True)), scaled, out)
        pictures = write_plots(encoder_plots(evaluation), out)
    for label, seen in evaluation["seen"].items():
        if seen == "maybe":
            click.echo(
                f"note: {label} was trained on other data of the same seed, so these episodes may "
                "not be new to it"
            )
    click.echo(evaluation_text(evaluation))
    click.echo("\n" + "\n".join(map(str, (out / EVALUATION, *pictures))))


@click.group()
def encoder() -> None:
    """Look at encoders, and export them."""


_which = click.argument("encoder")
_task = click.option("--task", help="Its task, for an encoder that ships.")


@encoder.command(epilog=example("jbrep encoder info dae-8 --task face_direction"))
@_which
@_task
def info(encoder: str, task: str | None) -> None:
    """Show what an encoder is and where it comes from."""
    from jbrep.encoders.card import card
    from jbrep.encoders.shipped import find_alone

    for line in card(find_alone(encoder, task)).splitlines():
        click.echo(printable(line))


@encoder.command(
    epilog=example("jbrep encoder export dae-8 --task face_direction --out dae-8.onnx")
)
@_which
@_task
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new .onnx file.")
def export(encoder: str, task: str | None, out: Path) -> None:
    """Write an encoder and its decoder as ONNX.

    The input is `observation`, in physical units; the outputs are `latent` and `reconstruction`.
    """
    from jbrep.encoders.onnx import export as run
    from jbrep.encoders.shipped import find_alone

    run(find_alone(encoder, task), out)
    click.echo(f"open it with onnxruntime.InferenceSession({str(out)!r})")
