"""Judging and looking at encoders."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import PATH, Variadic, as_json, data_option
from jbrep.cli.completion import complete_encoder, complete_task
from jbrep.cli.environment import (
    environment_options,
    given_task,
    import_option,
    needed_task,
    needed_task_option,
    task_option,
)
from jbrep.cli.output import echo_json, echo_text, say
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError
from jbrep.text import facts, printable, r2_text, slug, table, terminal_width, wrapped

if TYPE_CHECKING:
    from jbrep.encoders import Encoder
    from jbrep.encoders.base import BaseEncoder
    from jbrep.envs.task import Task
    from jbrep.evaluate.evaluation import Evaluation
    from jbrep.evaluate.table import Values


_LETTERS = 100  # of the name of a folder


@click.command(
    cls=Variadic,
    epilog="Example: jbrep evaluate --encoder dae-8 encoders/face/pca-8.safetensors "
    "--data data/face",
)
@click.option(
    "--encoder",
    shell_complete=complete_encoder,
    required=True,
    multiple=True,
    help="Files, names that ship, or code, mymodule:MyEncoder; one or several.",
)
@data_option
@click.option(
    "--out",
    type=PATH,
    help="A folder for evaluation.json and figures.  [default: evaluation/DATA/ENCODERS]",
)
@click.option(
    "--policy",
    help="A policy that does the task well: a run's folder, or a policy by name. By default the "
    "task's hand-written policy, if it has one.",
)
@click.option(
    "--truth",
    type=PATH,
    help="The data set that DATA was derived from with --hide: how well an encoder estimates what "
    "isn't seen.",
)
@click.option(
    "--all",
    "everything",
    is_flag=True,
    help="Show all other diagnostics, too; evaluation.json always has them.",
)
@import_option
@as_json
def evaluate(
    encoder: tuple[str, ...],
    data: Path,
    out: Path | None,
    policy: str | None,
    truth: Path | None,
    everything: bool,
    as_json: bool,
) -> None:
    """Show which encoders serve, and what each lacks.

    Judged on the held-out episodes: how well they predict the state and the reward, what they say
    of a good policy's value and action, linear and nonlinear probes, reconstruction, the latent's
    units, and the prediction of the next latent. An encoder of your own is code such as
    mymodule:MyEncoder; its module is imported, which runs it.
    """
    from jbrep import api
    from jbrep.dataset import Dataset
    from jbrep.encoders.shipped import check_found, find_all, source_of
    from jbrep.envs.names import import_code

    whole = Dataset(data)
    for name in encoder:
        import_code(name)
        check_found(name, whole.task)
    from jbrep.evaluate.evaluation import EVALUATION  # imports torch
    from jbrep.report.evaluation import evaluation_text
    from jbrep.report.figures import encoder_plots
    from jbrep.report.figures import write as write_plots

    encoders = find_all(encoder, whole.task)
    sources = {
        label: source_of(name, whole.task) for label, name in zip(encoders, encoder, strict=True)
    }
    out = out or Path("evaluation", slug(data.resolve().name), slug("+".join(encoders))[:_LETTERS])
    with stoppable("the same command starts over"):
        evaluation = api.evaluate(encoders, whole, out, policy=policy, truth=truth).evaluation
        pictures = write_plots(encoder_plots(evaluation), out)
    width = terminal_width()
    notes = [wrapped(printable(note), width) for note in _notes(encoders, sources, evaluation)]
    if as_json:
        click.echo("\n".join(notes), err=True)
        return echo_json(evaluation.as_json())
    click.echo(evaluation_text(evaluation, width, everything) + "\n")
    click.echo("\n".join(notes))
    click.echo()
    say(str(out / EVALUATION))
    more = "" if everything else " --all shows more."
    return click.echo(f"Beside it: {len(pictures)} figures.{more}")


def _notes(
    encoders: "Mapping[str, BaseEncoder]", sources: Mapping[str, str], evaluation: "Evaluation"
) -> list[str]:
    """Where encoders come from, and which may have seen the episodes that they were judged on."""
    taken = []
    for label, source in sources.items():
        line = source if source.startswith(label) else f"{label}: {source}"
        arguments = ", ".join(encoders[label].task.given_arguments)
        taken.append(f"{line}, made with {arguments}" if arguments else line)
    notes = [f"Judged: {'; '.join(taken)}."]
    if maybe := [label for label, seen in evaluation.seen.items() if seen == "maybe"]:
        notes.append(
            f"Perhaps not new to these episodes: {', '.join(maybe)}, whose training data has the "
            "same seed or isn't known."
        )
    return notes


@click.group(epilog="Example: jbrep encoder list")
def encoder() -> None:
    """Look at encoders, export and import them."""


_COLUMNS = {name: name for name in ("forward", "rewarded", "reward", "value", "action")}
_COLUMNS["times_pca"] = "error"


@encoder.command("list", epilog="Example: jbrep encoder list --task face_direction")
@click.option(
    "--task",
    shell_complete=complete_task,
    help="One of the Jitterbug's; all of them by default.",
)
@as_json
def list_shipped(task: str | None, as_json: bool) -> None:
    """Show which encoders ship, and how they were judged.

    A dash stands for what isn't known; jbrep evaluate finds out.
    """
    from jbrep.evaluate.table import SCALARS
    from jbrep.jitterbug.tasks import TASKS
    from jbrep.methods.registry import METHODS

    if task is not None and task not in TASKS:
        raise InputError(f"no encoder ships for {task}: only for {', '.join(TASKS)}")
    listed = {
        name: _with_diagnostics(TASKS[name].describe()) for name in ([task] if task else TASKS)
    }
    if as_json:
        return echo_json(
            {name: [_plain(*each) for each in encoders] for name, encoders in listed.items()}
        )
    width = terminal_width()
    for name, encoders in listed.items():
        rows = [
            (called, str(each.latent_size), *(r2_text(known.get(column)) for column in _COLUMNS))
            for called, each, known in encoders
        ]
        click.echo(f"{name}\n{table(('encoder', 'l', *_COLUMNS.values()), rows, width)}\n")
    kinds = dict.fromkeys(each.kind for encoders in listed.values() for _, each, _ in encoders)
    words = {kind: METHODS[kind].words() for kind in kinds}
    columns = {title: SCALARS[name].words for name, title in _COLUMNS.items()}
    columns["error"] = "squared error of the reconstruction, as a multiple of PCA's"
    click.echo(f"columns\n{facts({'l': 'size of the code', **columns}, width)}\n")
    return click.echo(f"kinds of encoders\n{facts(words, width)}")


def _plain(name: str, encoder: "Encoder", known: "Values") -> dict[str, Any]:
    """An encoder that ships, as JSON has it."""
    return {
        "name": name,
        "kind": encoder.kind,
        "size": encoder.size,
        "latent_size": encoder.latent_size,
        "sha256": encoder.fingerprint,
        "diagnostics": dict(known),
    }


def _with_diagnostics(task: "Task") -> "list[tuple[str, Encoder, Values]]":
    """The encoders that ship for a task, with what is known of each."""
    from jbrep.encoders.shipped import shipped, shipped_folder
    from jbrep.evaluate.table import DIAGNOSTICS, read_diagnostics

    rows = read_diagnostics(shipped_folder(task) / DIAGNOSTICS)
    known = {row.sha256: row.values for row in rows}
    return [(name, each, known.get(each.fingerprint, {})) for name, each in shipped(task).items()]


_which = click.argument("encoder", shell_complete=complete_encoder)


@encoder.command(epilog="Example: jbrep encoder info dae-8 --task face_direction")
@_which
@task_option
@environment_options
@as_json
def info(encoder: str, as_json: bool, **options: Any) -> None:
    """Show what an encoder is and where it comes from.

    ENCODER is a file, or, given its --task, the name of one that ships, or code such as
    mymodule:MyEncoder, whose module is imported: this runs it.
    """
    from jbrep.encoders.card import card, describe
    from jbrep.encoders.shipped import find_alone, source_of
    from jbrep.envs.names import import_code

    import_code(encoder)
    task = given_task(options)
    shown, source = find_alone(encoder, task), source_of(encoder, task)
    if as_json:
        return echo_json(describe(shown, source))
    echo_text(card(shown, source, terminal_width()))
    return None


@encoder.command(
    epilog="Example: jbrep encoder export dae-8 --task face_direction --out dae-8.onnx"
)
@_which
@task_option
@click.option("--out", required=True, type=PATH, help="A new .onnx file.")
@environment_options
def export(encoder: str, out: Path, **options: Any) -> None:
    """Write an encoder, with its decoder, as ONNX.

    The input is `observation`, in physical units; the outputs are `latent` and, if there is a
    decoder, `reconstruction`. ENCODER is as for `info`.
    """
    from jbrep.encoders import Encoder
    from jbrep.encoders.onnx import export as run
    from jbrep.encoders.shipped import find_alone, source_of
    from jbrep.envs.names import import_code

    import_code(encoder)
    task = given_task(options)
    exported = find_alone(encoder, task)
    if not isinstance(exported, Encoder):
        raise InputError(
            f"{encoder} is code, which can't be exported: give an encoder's file, as "
            "Encoder.from_torch makes it"
        )
    run(exported, out)
    say(f"exported {source_of(encoder, task)}")
    click.echo(f"open it with onnxruntime.InferenceSession({str(out)!r})")


@encoder.command(
    "import",
    epilog="Example: jbrep encoder import model.onnx --task face_direction "
    "--out encoders/mine.safetensors",
)
@click.argument("model", type=PATH)
@needed_task_option
@click.option(
    "--decoder",
    type=PATH,
    help="A model from latents back to observations, if MODEL has no reconstruction.",
)
@click.option("--name", help="What tables will call it; by default the name of the file.")
@click.option("--out", required=True, type=PATH, help="A new encoder file.")
@environment_options
def import_model(
    model: Path, decoder: Path | None, name: str | None, out: Path, **options: Any
) -> None:
    """Make an encoder file from an ONNX model.

    MODEL takes observations in physical units, (rows, features), and gives codes. It may be any
    graph; onnxruntime runs it.
    """
    from jbrep.encoders.card import card
    from jbrep.encoders.encoder import SUFFIX, Encoder, save_new
    from jbrep.records.storage import exists, taken

    task = needed_task(options)
    if exists(out):
        raise taken(out)
    made = Encoder.from_onnx(model, task, decoder, name or out.name.removesuffix(SUFFIX))
    save_new(made, out)
    echo_text(card(made, str(out), terminal_width()))
