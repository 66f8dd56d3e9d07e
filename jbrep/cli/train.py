"""Making encoders."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import POSITIVE, RESUMES, data_option, example, stoppable
from jbrep.cli.making import Making, read_options
from jbrep.errors import InputError

if TYPE_CHECKING:
    from jbrep.dataset import ScaledDataset
    from jbrep.methods.fit import Fitted

_POOR = 1.5  # times PCA's error, from which a trained autoencoder deserves a warning
_RECONSTRUCTING = ("ae", "dae")


class _Dae(Making):
    """For the denoising autoencoder alone."""

    kinds = ("dae",)


def _making(command: Callable[..., None]) -> Callable[..., None]:
    """The options of commands that make encoders, but for the methods' own."""
    for option in (
        click.option("--preset", help="Named settings; of dae: authors, its authors' own."),
        click.option(
            "--seeds",
            type=POSITIVE,
            metavar="N",
            help="Make N of each, of the seeds 0 to N - 1: NAME-s0, NAME-s1, ...",
        ),
        click.option("--device", default="auto", show_default=True, help="cpu, cuda, or auto."),
        click.option("--name", help="What files and tables call it; by default, what it is."),
        click.option(
            "--out",
            required=True,
            type=click.Path(path_type=Path),
            help="A folder for the encoder files.",
        ),
        data_option,
    ):
        command = option(command)
    return command


@click.command(
    cls=_Dae,
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
    cls=Making,
    epilog=example(
        "jbrep train-encoder --kind slow --data data/face --latent 8 --out encoders/face"
    ),
)
@click.option("--kind", required=True, help="One of those below.")
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
    seeds: int | None,
    device: str,
    preset: str | None,
    **options: Any,
) -> None:
    from jbrep.dataset import Dataset, ScaledDataset
    from jbrep.methods.fit import Fitter

    given = read_options(kind, options, preset)
    sizes = given.pop("latent", ())
    if name and len(sizes) > 1:
        raise InputError("one --name is for one latent size: give each its own")
    each: list[dict[str, Any]] = [{**given, "latent": size} for size in sizes] or [given]
    named = [pair for settings in each for pair in _of_seeds(kind, name, settings, seeds)]
    scaled = ScaledDataset(Dataset(data))
    for constant in scaled.constant_features:
        click.echo(f"{constant} is constant in the training part: it is scaled to 0", err=True)
    fitter = Fitter(scaled, out, device)
    for called, settings in named:  # every mistake is reported before the first training
        fitter.plan(kind, name=called, **settings)
    with stoppable(f"{RESUMES}; the best so far is in {out}"):
        for called, settings in named:
            _report(fitter.fit(kind, name=called, **settings), scaled)


def _of_seeds(
    kind: str, name: str | None, settings: dict[str, Any], seeds: int | None
) -> list[tuple[str | None, dict[str, Any]]]:
    """The name and settings of the encoder of each seed, or of the one if there are no seeds."""
    from jbrep.encoders.names import of_seed
    from jbrep.methods.registry import get_method, name_of

    if seeds is None:
        return [(name, settings)]
    method = get_method(kind)
    if "seed" not in method.own:
        raise InputError(f"{kind} has no seed, so all its encoders are the same: leave out --seeds")
    if "seed" in settings:
        raise InputError("--seed is for one encoder: leave it out, or --seeds")
    name = name or name_of(method, method.settings(settings))
    return [(of_seed(name, seed), {**settings, "seed": seed}) for seed in range(seeds)]


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
