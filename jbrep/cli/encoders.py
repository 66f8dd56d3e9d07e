"""Making, judging and looking at encoders."""

import re
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import (
    RESUMES,
    as_json,
    echo_json,
    echo_paths,
    example,
    printable,
    stoppable,
)
from jbrep.cli.environment import given_task, task_options
from jbrep.errors import InputError, choose
from jbrep.text import terminal_width

if TYPE_CHECKING:
    from jbrep.dataset import ScaledDataset
    from jbrep.methods.fit import Fitted
    from jbrep.methods.method import Method
    from jbrep.methods.settings import Setting

_POOR = 1.5  # times PCA's error, from which a trained autoencoder deserves a warning
_RECONSTRUCTING = ("ae", "dae")


class _Variadic(click.Command):
    """An option that may be repeated also takes several values at once: --latent 12 8 4."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        repeatable = {
            name
            for option in self.get_params(ctx)
            if isinstance(option, click.Option) and option.multiple
            for name in option.opts
        }
        spread: list[str] = []
        for i, arg in enumerate(args):
            follows = i > 1 and not arg.startswith("-") and not args[i - 1].startswith("-")
            name = next((a for a in reversed(args[:i]) if a.startswith("-")), None)
            spread += [name, arg] if follows and name in repeatable else [arg]
        return super().parse_args(ctx, spread)


class _Making(_Variadic):
    """A command with an option for each setting of the methods that it offers."""

    kinds: tuple[str, ...] = ()  # all of them if empty

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        *own, last = super().get_params(ctx)  # the last one is --help
        return [*own, *self._settings, last]

    @cached_property
    def _methods(self) -> "list[Method]":
        from jbrep.methods.registry import METHODS  # imports torch

        return [METHODS[name] for name in self.kinds or METHODS]

    @cached_property
    def _settings(self) -> list[click.Parameter]:
        from jbrep.methods.settings import SETTINGS

        taken = {name for method in self._methods for name in method.defaults}
        return [self._option(name, SETTINGS[name]) for name in SETTINGS if name in taken]

    def _option(self, name: str, setting: "Setting") -> click.Option:
        taking = [method.name for method in self._methods if name in method.defaults]
        some = "" if len(taking) == len(self._methods) else f" For {', '.join(taking)}."
        how: dict[str, Any] = {"help": f"{setting.words}{some}"}
        if name == "latent":
            how |= {"type": _Sizes(), "multiple": True}
        elif setting.is_flag:
            how |= {"is_flag": True, "default": None}
        return click.Option([f"--{name.replace('_', '-')}"], **how)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        super().format_options(ctx, formatter)
        if len(self._methods) > 1:
            with formatter.section("Kinds"):
                formatter.write_dl([(method.name, method.words) for method in self._methods])


class _MakingDae(_Making):
    """For the denoising autoencoder alone."""

    kinds = ("dae",)


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


def _making(command: Callable[..., None]) -> Callable[..., None]:
    """The options of commands that make encoders, but for the methods' own."""
    for option in (
        click.option("--preset", help="Named settings; of dae: authors, its authors' own."),
        click.option("--device", default="auto", show_default=True, help="cpu, cuda, or auto."),
        click.option("--name", help="What files and tables call it; by default, what it is."),
        click.option(
            "--out",
            required=True,
            type=click.Path(path_type=Path),
            help="A folder for the encoder files.",
        ),
        _data,
    ):
        command = option(command)
    return command


@click.command(
    cls=_MakingDae,
    epilog=example("jbrep train-dae --data data/face --latent 12 8 4 --out encoders/face"),
)
@_making
def train_dae(**options: Any) -> None:
    """Train denoising autoencoders.

    They learn from 80 % of the episodes, with the paper's settings by default; their error on the
    others is compared with PCA's. Ctrl-C keeps the best so far, and the same command resumes.
    """
    _fit("dae", **options)


@click.command(
    cls=_Making,
    epilog=example(
        "jbrep train-encoder --kind slow --data data/face --latent 8 --out encoders/face"
    ),
)
@click.option("--kind", required=True, help="One of those below; full is the whole observation.")
@_making
def train_encoder(kind: str, **options: Any) -> None:
    """Make encoders of any kind.

    They learn from 80 % of the episodes. Each kind takes only some of the settings.
    """
    _fit(kind, **options)


def _fit(
    kind: str,
    data: Path,
    out: Path,
    name: str | None,
    device: str,
    preset: str | None,
    latent: tuple[tuple[int, ...], ...] = (),
    **how: Any,
) -> None:
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.methods.fit import Fitter
    from jbrep.methods.registry import get_method

    method = get_method(kind)
    given = {key: value for key, value in how.items() if value is not None}
    if preset is not None:
        given = {**choose(preset, method.presets, f"preset of {kind}"), **given}
    sizes = dict.fromkeys(size for each in latent for size in each)
    if name and len(sizes) > 1:
        raise InputError("one name is for one latent size: give each its own")
    each: list[dict[str, Any]] = [{"latent": size} for size in sizes] or [{}]
    scaled = ScaledDataset(Dataset(data))
    for constant in scaled.constant_features:
        click.echo(f"{constant} is constant in the training part: it is scaled to 0", err=True)
    fitter = Fitter(scaled, out, device)
    settings = [{**given, **one, "name": name} for one in each]
    for one in settings:  # every mistake is reported before the first training
        fitter.plan(kind, **one)
    with stoppable(f"{RESUMES}; the best so far is in {out}"):
        for one in settings:
            _report(fitter.fit(kind, **one), scaled)


def _report(fitted: "Fitted", data: "ScaledDataset") -> None:
    """Say how an encoder that was fitted to that data compares with PCA."""
    from jbrep.encoders.file import HELD_OUT_MSE
    from jbrep.methods.held_out import ratio_to_pca

    encoder, path, is_new = fitted
    ratio = ratio_to_pca(encoder, data)
    comparison = "" if ratio is None else f", {ratio:.2f} times PCA's"
    click.echo(
        f"{encoder.name}: held-out mean squared error {encoder.header['metrics'][HELD_OUT_MSE]:.5f}"
        f"{comparison} (features scaled to [-1, 1]); {path}{'' if is_new else ', already complete'}"
    )
    if ratio is not None and ratio > _POOR and encoder.kind in _RECONSTRUCTING:
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
@click.option(
    "--policy",
    help="That does the task well: a run's folder, or a policy by name. By default the task's "
    "hand-written policy, if it has one.",
)
@as_json
def evaluate(
    encoder: tuple[str, ...], data: Path, out: Path, policy: str | None, as_json: bool
) -> None:
    """Show what encoders lose and keep, side by side.

    Judged on the held-out episodes: how well they foretell the state and the reward, what they say
    of a good policy's value and action, linear and nonlinear probes, reconstruction, corruption,
    the latent's units and dimensions, nearest neighbours, and the prediction of the next latent. An
    encoder of your own is code such as mymodule:MyEncoder; its module is imported, which runs it.
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
    from jbrep.rollouts.good_policy import find_good_policy

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
        evaluation = write(labelled, scaled, out, find_good_policy(policy, scaled.task))
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
