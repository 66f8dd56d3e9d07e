"""Evaluating and looking at encoders."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from jbrep import api
from jbrep.cli.base import command, say, say_json, tell
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError
from jbrep.parameters import AsJson, OptionalTask, TaskName
from jbrep.text import facts, r2_text, slug, table, terminal_width

if TYPE_CHECKING:
    from jbrep.encoders import Encoder
    from jbrep.encoders.base import BaseEncoder
    from jbrep.encoders.encoder import Layers
    from jbrep.envs.task import Task
    from jbrep.evaluation.evaluation import Evaluation
    from jbrep.evaluation.table import Values


_RECORDS = ("training", "data", "metrics", "versions")
_LETTERS = 100  # of the name of a folder
_Which = Annotated[str, Meta(extra={"is_code": True, "option": "encoder"})]


@command("evaluate --encoder dae-8 encoders/face/pca-8.safetensors --data data/face")
def evaluate(
    encoders: Annotated[Sequence[str], Meta(extra={"is_code": True, "option": "encoder"})],
    data: Path,
    *,
    out: Path | None = None,
    everything: Annotated[bool, Meta(extra={"option": "all"})] = False,
    as_json: AsJson = False,
    **options: Annotated[Any, api.evaluate],
) -> None:
    """Show which encoders retain enough, and what each misses.

    Measured on the held-out episodes: how well they predict changes of the state and the reward, a
    good policy's value and action, and the features, and how well they reconstruct these. An
    encoder of your own is code such as mymodule:MyEncoder; its module is imported, which runs it.

    Args:
        encoders: files, names that ship, or code, mymodule:MyEncoder; one or several.
        data: a folder from jbrep collect.
        out: a folder for evaluation.json; by default evaluation/DATA/ENCODERS.
        everything: show all other diagnostics, too; evaluation.json always has them.
    """
    from jbrep.dataset import Dataset
    from jbrep.encoders.shipped import check_found, find_all, source_of

    whole = Dataset(data)
    for name in encoders:
        check_found(name, whole.task)
    from jbrep.evaluation.evaluation import EVALUATION  # imports torch
    from jbrep.reporting.evaluation import evaluation_text

    found = find_all(encoders, whole.task)
    sources = {
        label: source_of(name, whole.task) for label, name in zip(found, encoders, strict=True)
    }
    out = out or Path("evaluation", slug(data.resolve().name), slug("+".join(found))[:_LETTERS])
    with stoppable("the same command starts over"):
        evaluation = api.evaluate(found, whole, out, **options).evaluation
    if as_json:
        _tell_notes(found, sources, evaluation, err=True)
        return say(evaluation.text().rstrip())
    say(evaluation_text(evaluation, terminal_width(), everything) + "\n")
    _tell_notes(found, sources, evaluation)
    return say(f"\n{out / EVALUATION}")


def _tell_notes(
    encoders: "Mapping[str, BaseEncoder]",
    sources: Mapping[str, str],
    evaluation: "Evaluation",
    err: bool = False,
) -> None:
    """Say where encoders come from, and which may have seen what they are evaluated on."""
    taken = []
    for label, source in sources.items():
        line = source if source.startswith(label) else f"{label}: {source}"
        arguments = ", ".join(encoders[label].task.given_arguments)
        taken.append(f"{line}, made with {arguments}" if arguments else line)
    tell(f"Evaluated: {'; '.join(taken)}.", err)
    if maybe := [label for label, seen in evaluation.seen.items() if seen == "maybe"]:
        tell(
            f"May have been trained on these episodes: {', '.join(maybe)} (training data of the "
            "same seed, or unknown).",
            err,
        )


_COLUMNS = {  # by the names of diagnostics, those of the columns
    **{name: name for name in ("forward", "rewarded", "reward", "value", "action")},
    "times_pca": "error",
}


@command("encoder list --task face_direction")
def list_shipped(*, task: TaskName = None) -> None:
    """Show which encoders ship, and how they were judged.

    A dash means unknown; jbrep evaluate measures it.

    Args:
        task: one of the Jitterbug's; all of them by default.
    """
    from jbrep.jitterbug.tasks import TASKS

    if task is not None and task not in TASKS:
        raise InputError(f"no encoder ships for {task}: only for {', '.join(TASKS)}")
    listed = {
        name: _with_diagnostics(TASKS[name].describe()) for name in ([task] if task else TASKS)
    }
    width = terminal_width()
    for name, encoders in listed.items():
        rows = [
            (called, str(each.latent_size), *(r2_text(known.get(column)) for column in _COLUMNS))
            for called, each, known in encoders
        ]
        say(f"{name}\n{table(('encoder', 'l', *_COLUMNS.values()), rows, width)}\n")
    tell("Columns are R² on held-out episodes, and the error as a multiple of PCA's.")
    tell("jbrep train-encoder --help explains the kinds of encoders.")


def _with_diagnostics(task: "Task") -> "list[tuple[str, Encoder, Values]]":
    """The encoders that ship for a task, with what is known of each."""
    from jbrep.encoders.shipped import shipped, shipped_folder
    from jbrep.evaluation.table import DIAGNOSTICS, read_diagnostics

    rows = read_diagnostics(shipped_folder(task) / DIAGNOSTICS)
    known = {row.sha256: row.values for row in rows}
    return [(name, each, known.get(each.fingerprint, {})) for name, each in shipped(task).items()]


@command("encoder info dae-8 --task face_direction")
def info(encoder: _Which, /, *, task: OptionalTask = None, as_json: AsJson = False) -> None:
    """Show what an encoder is and where it comes from.

    ENCODER is a file, or, given its --task, the name of one that ships, or code such as
    mymodule:MyEncoder, whose module is imported: this runs it.
    """
    from jbrep.encoders.shipped import find_alone, source_of

    shown, source = find_alone(encoder, task), source_of(encoder, task)
    if as_json:
        return say_json(_described(shown, source))
    return say(card(shown, source, terminal_width()))


@command("encoder export dae-8 --task face_direction --out dae-8.onnx")
def export(encoder: _Which, /, out: Path, *, task: OptionalTask = None) -> None:
    """Write an encoder, with its decoder, as ONNX.

    The input is `observation`, in physical units; the outputs are `latent` and, if there is a
    decoder, `reconstruction`. ENCODER is as for jbrep encoder info.

    Args:
        out: a new .onnx file.
    """
    from jbrep.encoders import Encoder
    from jbrep.encoders.onnx import export as run
    from jbrep.encoders.shipped import find_alone, source_of

    exported = find_alone(encoder, task)
    if not isinstance(exported, Encoder):
        raise InputError(
            f"{encoder} is code, which can't be exported: give an encoder's file, as "
            "Encoder.from_torch makes it"
        )
    run(exported, out)
    say(f"exported {source_of(encoder, task)}")
    say(f"open it with onnxruntime.InferenceSession({str(out)!r})")


@command("encoder import model.onnx --task face_direction --out encoders/mine.safetensors")
def import_model(
    model: Path,
    /,
    out: Path,
    *,
    task: OptionalTask = None,
    data: Annotated[Path | None, Meta(extra={"metavar": "FOLDER"})] = None,
    decoder: Path | None = None,
    name: str = "",
) -> None:
    """Make an encoder file from an ONNX model.

    MODEL takes observations in physical units, (rows, features), and gives codes. It may be any
    graph; onnxruntime runs it.

    Args:
        out: a new encoder file.
        data: a data set whose observations it encodes, in place of a task.
        decoder: a model from latents back to observations, if MODEL has no reconstruction.
        name: what tables will call it; by default the name of the file.
    """
    from jbrep.dataset import Dataset
    from jbrep.encoders.encoder import SUFFIX, Encoder, pack
    from jbrep.records.storage import exists, taken, write_new

    if exists(out):
        raise taken(out)
    if (task is None) == (data is None):
        raise InputError("give --task, or else --data, a folder from jbrep data import")
    known = task or Dataset(data or "").task
    made = Encoder.from_onnx(model, known, decoder, name or out.name.removesuffix(SUFFIX))
    write_new(out, pack(made))
    say(card(made, str(out), terminal_width()))


def _described(encoder: "BaseEncoder", source: str) -> dict[str, Any]:
    """An encoder's card as plain JSON, with its source, as `source_of` says it."""
    from jbrep.encoders import Encoder

    task = encoder.task
    plain = {
        "name": encoder.name,
        "source": source,
        "task": task.name,
        "environment": task.id,
        "arguments": dict(task.arguments),
        "kind": encoder.kind,
        "size": encoder.size,
        "latent_size": encoder.latent_size,
    }
    if not isinstance(encoder, Encoder):
        return {**plain, "decodes": encoder.can_decode, "sha256": encoder.fingerprint}
    features = encoder.scaler.features(encoder.task)
    ranges = zip(features, encoder.scaler.low, encoder.scaler.high, strict=True)
    return {
        **plain,
        "encoder": _layers(encoder.encoder),
        "decoder": _layers(encoder.decoder),
        **{name: getattr(encoder.header, name) for name in _RECORDS},
        "sha256": encoder.fingerprint,
        "features": [
            {"name": feature.name, "unit": feature.unit, "low": float(low), "high": float(high)}
            for feature, low, high in ranges
        ],
    }


def card(encoder: "BaseEncoder", source: str, width: int) -> str:
    """The same in lines; of a file, also the range of each feature, scaled to [-1, 1]."""
    plain = _described(encoder, source)
    features = plain.pop("features", ())
    for part in ("encoder", "decoder"):
        if part in plain:
            layers = (f"{layer['units']} {layer['activation']}" for layer in plain[part])
            plain[part] = " -> ".join(layers) or "none"
    named = {name: _said(value) for name, value in plain.items() if value not in ({}, encoder.name)}
    text = f"{encoder.name}\n{facts(named, width)}"
    rows = [(f["name"], f["unit"], f"{f['low']:.4g}", f"{f['high']:.4g}") for f in features]
    return f"{text}\n\n{table(('feature', 'unit', 'low', 'high'), rows)}" if rows else text


def _layers(layers: "Layers") -> list[dict[str, Any]]:
    return [{"units": layer.units, "activation": layer.activation} for layer in layers]


def _said(value: Any) -> str:
    """As latent 8, policy (kind uniform)."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, Mapping):
        return str(value)
    parts = (
        f"{n} ({_said(v)})" if isinstance(v, Mapping) else f"{n} {v}" for n, v in value.items()
    )
    return ", ".join(parts)
