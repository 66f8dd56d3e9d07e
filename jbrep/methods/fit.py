"""Encoders of every kind from a data set, each in its file."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from jbrep.dae import checkpoint
from jbrep.dae.network import Autoencoder, get_architecture, layers
from jbrep.dae.training import Epoch, Trainer, Training, get_device
from jbrep.dataset import ScaledDataset
from jbrep.dataset.scaled import sample
from jbrep.encoders import Encoder, load, save
from jbrep.encoders.file import HELD_OUT_MSE, SUFFIX
from jbrep.errors import InputError, choose, differences
from jbrep.files.lock import exclusive
from jbrep.files.storage import exists, make_folder
from jbrep.methods.controls import Layers, pca, random_projection
from jbrep.progress import Progress

_WATCHED = 100_000  # held-out rows whose error is shown after each epoch
_EVERY = ("latent", "architecture", "epochs", "batch_size", "learning_rate", "seed")


def _untrained(data: ScaledDataset, training: Training) -> tuple[Layers, Layers]:
    architecture = get_architecture(training.architecture)
    network = Autoencoder(architecture, data.task.size, training.latent, training.seed)
    return layers(network.encoder), layers(network.decoder)


class _Kind(NamedTuple):
    settings: tuple[str, ...]  # of a Training that matter to it
    make: Callable[[ScaledDataset, Training], tuple[Layers, Layers]] | None  # None: trained


KINDS = {
    "identity": _Kind((), lambda data, training: ((), ())),
    "pca": _Kind(("latent",), lambda data, training: pca(data, training.latent)),
    "random": _Kind(
        ("latent", "seed"),
        lambda data, training: random_projection(data, training.latent, training.seed),
    ),
    "untrained": _Kind(("latent", "architecture", "seed"), _untrained),
    "ae": _Kind(_EVERY, None),
    "dae": _Kind((*_EVERY, "noise"), None),
}


def get_kind(kind: str) -> _Kind:
    """What a kind of encoder needs.

    Raises:
        InputError: there is none of that name; the message lists them.
    """
    return choose(kind, KINDS, "kind")


class Fitted(NamedTuple):
    """An encoder in its file."""

    encoder: Encoder
    path: Path
    anew: bool  # False where the file held it already


class Fitter:
    """Makes encoders from one data set, into one folder.

    The encoder `dae-8` is the file `dae-8.safetensors` there; `dae-8.training` beside it has
    TensorBoard's scalars and, until it is done, the checkpoint to go on from.

    Args:
        data: to learn from.
        folder: made if it isn't there.
        device: to train on: cpu, cuda, or auto.
    """

    def __init__(self, data: ScaledDataset, folder: Path, device: str = "auto"):
        self._data = data
        self._folder = folder
        self._device = get_device(device)

    def fit(self, kind: str, training: Training) -> Fitted:
        """Make an encoder, unless its file is there already.

        Interrupted, an autoencoder in training leaves the best so far in the file, and its
        checkpoint, from which the same call goes on.

        Raises:
            InputError: as `check` does, or the files can't be written.
        """
        header, path = self._plan(kind, training)
        if exists(path) and _is_done(path, header):
            return Fitted(load(path), path, False)
        make_folder(self._folder)
        if make := KINDS[kind].make:
            self._save(header, make(self._data, training), path, {})
        else:
            work = path.with_suffix(".training")
            make_folder(work)
            with exclusive(work):
                noise = header["training"].get("noise", 0)
                self._train(header, replace(training, noise=noise), path, work)
        return Fitted(load(path), path, True)

    def check(self, kind: str, training: Training) -> bool:
        """Make sure that it can be made; whether it is there already.

        Raises:
            InputError: an unknown kind, a latent size out of range, or a file of other settings or
                data.
        """
        header, path = self._plan(kind, training)
        return exists(path) and _is_done(path, header)

    def _plan(self, kind: str, training: Training) -> tuple[dict[str, Any], Path]:
        """The header of what is asked for, and its file, once it is found to be possible."""
        get_kind(kind)
        header = self._header(kind, training)
        _check(kind, header["training"], self._data.task.size)
        return header, self._folder / f"{header['name']}{SUFFIX}"

    def _header(self, kind: str, training: Training) -> dict[str, Any]:
        """What an encoder is and where it comes from."""
        settings = {name: getattr(training, name) for name in KINDS[kind].settings}
        manifest = self._data.dataset.manifest
        architecture = settings.get("architecture", "paper")
        words = [kind, *([architecture] if architecture != "paper" else [])]
        words += [str(settings["latent"])] if "latent" in settings else []
        return {
            "kind": kind,
            "name": "-".join(words),
            "task": self._data.task.name,
            "features": list(self._data.task.feature_names),
            "training": settings,
            "data": {
                "fingerprint": manifest.fingerprint,
                "policy": dict(manifest.settings.policy),
                "seed": manifest.settings.seed,
                "train_rows": len(self._data.train),
                "test_rows": len(self._data.test),
            },
            "versions": {name: version(name) for name in ("jbrep", "numpy", "torch")},
        }

    def _train(self, header: dict[str, Any], training: Training, path: Path, work: Path) -> None:
        """Train from the checkpoint there is, or from the start."""
        trainer = Trainer(training, *self._rows)
        versions = {"device": self._device.type, "torch": header["versions"]["torch"]}
        identity = {**_identity(header), **versions}
        at = work / "checkpoint.safetensors"
        if at.exists():
            checkpoint.restore(trainer, identity, at)
        try:
            with SummaryWriter(str(work), purge_step=len(trainer.history) + 1) as scalars:
                for _ in _shown(trainer, header["name"]):
                    checkpoint.save(trainer, identity, at)
                    for name, value in trainer.history[-1]._asdict().items():
                        scalars.add_scalar(name, value, len(trainer.history))
        finally:
            if trainer.history:
                self._save_best(header, trainer, path)
        at.unlink()

    def _save_best(self, header: dict[str, Any], trainer: Trainer, path: Path) -> None:
        trainer.network.load_state_dict(trainer.best)
        parts = layers(trainer.network.encoder), layers(trainer.network.decoder)
        best = trainer.best_epoch
        metrics = {
            "epochs": len(trainer.history),
            "best_epoch": best,
            "train_loss": trainer.history[best - 1].train_loss,
        }
        self._save(header, parts, path, metrics)

    def _save(
        self, header: dict[str, Any], parts: tuple[Layers, Layers], path: Path, metrics: Any
    ) -> None:
        """Write the file, with the error on all held-out rows."""
        encoder = Encoder(header, self._data.scaler, *parts)
        error = held_out_error(encoder, self._data)
        save(replace(encoder, header={**header, "metrics": {**metrics, HELD_OUT_MSE: error}}), path)

    @cached_property
    def _rows(self) -> tuple[Tensor, Tensor]:
        """Training rows, and some held-out ones from all over, on the device."""
        test = sample(self._data.test, _WATCHED)
        train, watched = (
            torch.from_numpy(self._data.load(rows)).to(self._device)
            for rows in (self._data.train, test)
        )
        return train, watched


def held_out_error(encoder: Encoder, data: ScaledDataset) -> float:
    """Mean squared error of the reconstruction over all held-out rows, scaled to [-1, 1].

    In six digits: those after them differ with the number of threads.
    """
    total = 0.0
    for rows in data.observations(data.test):
        error = (encoder.decode(encoder.encode(rows)) - rows) / data.scaler.half_width
        total += float(np.square(error, dtype=np.float64).sum())
    return float(f"{total / (len(data.test) * data.task.size):.6g}")


def _check(kind: str, settings: dict[str, Any], size: int) -> None:
    if not 1 <= settings.get("latent", 1) < size:
        raise InputError(
            f"the latent size is {settings['latent']}: there are {size} features, so it must be "
            f"from 1 to {size - 1}"
        )
    if settings.get("noise") == 0:
        raise InputError(f"{kind} without noise is a plain autoencoder: take the kind ae")


def _is_done(path: Path, header: dict[str, Any]) -> bool:
    """Whether the file has what is asked for; one that is half trained is to be gone on with.

    Raises:
        InputError: the file is of other settings or other data.
    """
    there = load(path).header
    asked = _identity(header)
    if differing := differences(_identity(there), asked):
        raise InputError(
            f"{path} is made otherwise: {differing}; take another folder, or delete it"
        )
    return there["metrics"].get("epochs") == asked.get("epochs")


def _identity(header: Mapping[str, Any]) -> dict[str, Any]:
    """What makes two encoders of one name the same."""
    data = header["data"].get("fingerprint")
    return {**header["training"], "kind": header["kind"], "task": header["task"], "data": data}


def _shown(trainer: Trainer, name: str) -> Iterator[Epoch]:
    """The epochs, with progress."""
    total, done = trainer.training.epochs, len(trainer.history)
    with Progress(total=total, initial=done, desc=name, unit="epoch") as progress:
        for epoch in trainer.epochs():
            progress.set_postfix(train=f"{epoch.train_loss:.5f}", test=f"{epoch.test_loss:.5f}")
            progress.update()
            yield epoch
