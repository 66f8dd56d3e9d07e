"""Making, judging and looking at encoders."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import (
    COUNT,
    RESUMES,
    as_json,
    echo_json,
    echo_paths,
    example,
    printable,
    stoppable,
)
from jbrep.cli.environment import given_task, task_options
from jbrep.errors import InputError
from jbrep.text import terminal_width

if TYPE_CHECKING:
    from jbrep.dataset import ScaledDataset
    from jbrep.methods.fit import Fitted

_POOR = 1.5  # times PCA's error, from which a trained encoder deserves a warning


class _Variadic(click.Command):
    """An option that may be repeated also takes several values at once: --latent 12 8 4."""

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


class _Sizes(click.ParamType[tuple[int, ...]]):
    """One or more sizes: 8, or 12,8,4."""

    name = "sizes"

    def convert(
        self, value: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        if not re.fullmatch(r"[0-9]{1,9}(,[0-9]{1,9})*,?", value):
            self.fail(f"{value!r} is not a list of sizes: write 12 8 4 or 12,8,4")
        return tuple(int(size) for size in value.split(",") if size)


_data = click.option(
    "--data", required=True, type=click.Path(path_type=Path), help="A folder from jbrep collect."
)
_out = click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="A folder for the encoder files."
)
_latent = click.option(
    "--latent", type=_Sizes(), multiple=True, help="Latent sizes l, one or several: 12 8 4."
)
_noise = click.option(
    "--noise", type=float, help="Standard deviation of the corruption; 0.1 by default."
)


def _how(command: Callable[..., None]) -> Callable[..., None]:
    """The options of every kind that has a network."""
    options = (
        click.option(
            "--architecture",
            help="paper, the default; deep; or sizes of your own, such as 64,64.",
        ),
        click.option(
            "--epochs",
            type=COUNT,
            help="Passes over the data; by default 200 or, if not paper, 12.",
        ),
        click.option(
            "--batch-size",
            type=COUNT,
            help="Rows in a batch; by default from the rows, 128 to 8192.",
        ),
        click.option(
            "--learning-rate", type=float, help="Of Adam; by default 5e-4 or, if not paper, 2e-3."
        ),
        click.option("--seed", type=COUNT, help="Of weights, order and noise; 0 by default."),
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

    They learn from 80 % of the episodes, with the paper's settings by default; their error on the
    others is compared with PCA's. Ctrl-C keeps the best so far, and the same command resumes.
    """
    _fit("dae", **options)


@click.command(
    cls=_Variadic,
    epilog=example(
        "jbrep train-encoder --kind pca --data data/face --latent 8 --out encoders/face"
    ),
)
@click.option("--kind", required=True, help="full, pca, random, untrained, ae (no noise) or dae.")
@_data
@_latent
@_how
@_noise
@_out
def train_encoder(kind: str, **options: Any) -> None:
    """Make encoders of any kind, to compare with.

    The full observation, scaled; principal components; a random projection; an untrained network; a
    plain autoencoder; or a denoising one.
    """
    from jbrep.encoders.encoder import FULL, IDENTITY

    _fit(IDENTITY if kind == FULL else kind, **options)


def _fit(
    kind: str, data: Path, latent: tuple[tuple[int, ...], ...], out: Path, device: str, **how: Any
) -> None:
    from jbrep.dae.training import Training
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.methods.fit import Fitter, get_kind

    sizes = dict.fromkeys(size for each in latent for size in each)
    given = {name: value for name, value in how.items() if value is not None}
    settings = get_kind(kind).settings
    for name in (*given, *(["latent"] if sizes else [])):
        if name not in settings:
            raise InputError(f"{kind} takes no --{name.replace('_', '-')}: leave it out")
    if "latent" in settings and not sizes:
        raise InputError(f"{kind} needs latent sizes, such as --latent 12 8 4")
    trainings = [Training.of(size, **given) for size in sizes or (None,)]
    scaled = ScaledDataset(Dataset(data))
    for name in scaled.constant_features:
        click.echo(f"{name} is constant in the training part: it is scaled to 0", err=True)
    fitter = Fitter(scaled, out, device)
    for training in trainings:  # every mistake is reported before the first training
        fitter.check(kind, training)
    with stoppable(f"{RESUMES}; the best so far is in {out}"):
        for training in trainings:
            _report(fitter.fit(kind, training), scaled)


def _report(fitted: "Fitted", data: "ScaledDataset") -> None:
    """Say how an encoder that was fitted to that data compares with PCA."""
    from jbrep.encoders.file import HELD_OUT_MSE
    from jbrep.methods.fit import KINDS
    from jbrep.methods.held_out import ratio_to_pca

    encoder, path, is_new = fitted
    ratio = ratio_to_pca(encoder, data)
    comparison = "" if ratio is None else f", {ratio:.2f} times PCA's"
    click.echo(
        f"{encoder.name}: held-out mean squared error {encoder.header['metrics'][HELD_OUT_MSE]:.5f}"
        f"{comparison} (features scaled to [-1, 1]); {path}{'' if is_new else ', already complete'}"
    )
    if ratio is not None and ratio > _POOR and KINDS[encoder.header["kind"]].make is None:
        click.echo(
            f"warning: {encoder.name} reconstructs worse than PCA with as many components: train "
            "for more --epochs, on more data, or with another --learning-rate or --batch-size",
            err=True,
        )


@click.command(
    cls=_Variadic,
    epilog=example(
        "jbrep evaluate --encoder dae-8 encoders/face/pca-8.safetensors --data data/face"
    ),
)
@click.option(
    "--encoder",
    required=True,
    multiple=True,
    help="Files, names that ship, or code, mymodule:MyEncoder; one or several.",
)
@_data
@click.option(
    "--out",
    default="evaluation",
    show_default=True,
    type=click.Path(path_type=Path),
    help="A folder for evaluation.json and figures.",
)
@as_json
def evaluate(encoder: tuple[str, ...], data: Path, out: Path, as_json: bool) -> None:
    """Show what encoders lose and keep, side by side.

    Judged on the held-out episodes: reconstruction, corruption, the latent's units and dimensions,
    linear probes, nearest neighbours, and the prediction of the next latent. An encoder of your own
    is code such as mymodule:MyEncoder; its module is imported, which runs it.
    """
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.encoders import find
    from jbrep.encoders.card import arguments_of
    from jbrep.encoders.code import import_code
    from jbrep.encoders.shipped import source_of
    from jbrep.evaluate.files import EVALUATION, write
    from jbrep.evaluate.summary import evaluation_text
    from jbrep.figures import encoder_plots
    from jbrep.figures import write as write_plots

    for name in encoder:
        import_code(name)
    scaled = ScaledDataset(Dataset(data))
    encoders = [find(name, scaled.task) for name in encoder]
    sources = [source_of(name, scaled.task) for name in encoder]
    labels = _labels([each.representation for each in encoders], sources)
    if twice := {label for label in labels if labels.count(label) > 1}:
        raise InputError(f"{min(twice)} is given twice: leave one out")
    labelled = dict(zip(labels, encoders, strict=True))
    with stoppable("the same command starts over"):
        evaluation = write(labelled, scaled, out)
        pictures = write_plots(encoder_plots(evaluation), out)
    for label, source in zip(labels, sources, strict=True):
        line = source if source.startswith(label) else f"{label}: {source}"
        arguments = arguments_of(labelled[label].task)
        click.echo(printable(f"{line}, made with {arguments}" if arguments else line), err=as_json)
    for label, seen in evaluation["seen"].items():
        if seen == "maybe":
            click.echo(
                printable(
                    f"note: {label} may have seen these episodes: the data it was trained on has "
                    "the same seed, or isn't known"
                ),
                err=as_json,
            )
    if as_json:
        return echo_json(evaluation)
    click.echo(f"\n{evaluation_text(evaluation, terminal_width())}")
    return echo_paths((out / EVALUATION, *pictures))


def _labels(names: list[str], sources: list[str]) -> list[str]:
    """What tables call encoders: their names, or their sources where a name is taken."""
    from jbrep.encoders import FULL
    from jbrep.encoders.file import SUFFIX

    taken = [FULL, *names]
    return [
        name if taken.count(name) == 1 else source.removesuffix(SUFFIX).removesuffix(", code")
        for name, source in zip(names, sources, strict=True)
    ]


@click.group()
def encoder() -> None:
    """Look at encoders, export and import them."""


_which = click.argument("encoder")


@encoder.command(epilog=example("jbrep encoder info dae-8 --task face_direction"))
@_which
@task_options()
@as_json
def info(encoder: str, as_json: bool, **options: Any) -> None:
    """Show what an encoder is and where it comes from.

    ENCODER is a file, or, given its --task, the name of one that ships, or code such as
    mymodule:MyEncoder, whose module is imported: this runs it.
    """
    from jbrep.encoders.card import card, describe
    from jbrep.encoders.code import import_code
    from jbrep.encoders.shipped import find_alone, source_of

    import_code(encoder)
    task = given_task(options, required=False)
    shown, source = find_alone(encoder, task), source_of(encoder, task)
    if as_json:
        return echo_json(describe(shown, source))
    for line in card(shown, source, terminal_width()).splitlines():
        click.echo(printable(line))
    return None


@encoder.command(
    epilog=example("jbrep encoder export dae-8 --task face_direction --out dae-8.onnx")
)
@_which
@task_options()
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new .onnx file.")
def export(encoder: str, out: Path, **options: Any) -> None:
    """Write an encoder, with its decoder, as ONNX.

    The input is `observation`, in physical units; the outputs are `latent` and, if there is a
    decoder, `reconstruction`. ENCODER is as for `info`.
    """
    from jbrep.encoders import Encoder
    from jbrep.encoders.code import import_code
    from jbrep.encoders.onnx import export as run
    from jbrep.encoders.shipped import find_alone, source_of

    import_code(encoder)
    task = given_task(options, required=False)
    exported = find_alone(encoder, task)
    if not isinstance(exported, Encoder):
        raise InputError(
            f"{encoder} is code, which can't be exported: give an encoder's file, as "
            "Encoder.from_torch makes it"
        )
    run(exported, out)
    click.echo(f"exported {printable(source_of(encoder, task))}")
    click.echo(f"open it with onnxruntime.InferenceSession({str(out)!r})")


@encoder.command(
    "import",
    epilog=example(
        "jbrep encoder import model.onnx --task face_direction --out encoders/mine.safetensors"
    ),
)
@click.argument("model", type=click.Path(path_type=Path))
@task_options()
@click.option(
    "--decoder",
    type=click.Path(path_type=Path),
    help="A model from latents back to observations, if MODEL has no reconstruction.",
)
@click.option("--name", help="What tables will call it; by default the name of the file.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="A new encoder file.")
def import_model(
    model: Path, decoder: Path | None, name: str | None, out: Path, **options: Any
) -> None:
    """Make an encoder file from an ONNX model.

    MODEL takes observations in physical units, (rows, features), and is a chain of dense layers
    with the usual activations and normalisations. Nothing in it is run.
    """
    from jbrep.encoders.card import card
    from jbrep.encoders.file import SUFFIX, save
    from jbrep.encoders.from_onnx import convert
    from jbrep.files.storage import exists

    task = given_task(options)
    assert task is not None
    if exists(out):
        raise InputError(f"{out} exists already: choose another file")
    made = convert(model, task, decoder, name or out.name.removesuffix(SUFFIX))
    save(made, out)
    for line in card(made, str(out), terminal_width()).splitlines():
        click.echo(printable(line))
