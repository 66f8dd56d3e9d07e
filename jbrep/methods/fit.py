"""Making encoders of every kind from a data set, each in its file."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from jbrep.dae import checkpoint
from jbrep.dae.network import Autoencoder, check_size, get_architecture, layers
from jbrep.dae.training import (
    Epoch,
    Rows,
    Trainer,
    Training,
    default_batch_size,
    get_device,
)
from jbrep.dataset import ScaledDataset
from jbrep.encoders import FULL, Encoder, load, save
from jbrep.encoders.encoder import IDENTITY
from jbrep.encoders.file import HELD_OUT_MSE, SUFFIX
from jbrep.encoders.names import EncoderName
from jbrep.errors import InputError, choose, differences
from jbrep.files.commit import commits
from jbrep.files.lock import exclusive
from jbrep.files.storage import exists, make_folder
from jbrep.methods.controls import Layers, pca, random_projection
from jbrep.methods.held_out import held_out_error
from jbrep.methods.rows import training_rows, watched_rows
from jbrep.progress import Progress

_TRAINED = ("latent", "architecture", "epochs", "batch_size", "learning_rate", "seed")


def _identity(data: ScaledDataset) -> tuple[Layers, Layers]:
    return (), ()


def _untrained(
    data: ScaledDataset, latent: int, architecture: str, seed: int
) -> tuple[Layers, Layers]:
    network = Autoencoder(get_architecture(architecture), data.task.size, latent, seed)
    return layers(network.encoder), layers(network.decoder)


class Kind(NamedTuple):
    """A kind of encoder: the settings of a Training that it takes, and how it is made."""

    settings: tuple[str, ...]
    make: Callable[..., tuple[Layers, Layers]] | None  # from data and settings; None: by training


KINDS = {
    IDENTITY: Kind((), _identity),
    "pca": Kind(("latent",), pca),
    "random": Kind(("latent", "seed"), random_projection),
    "untrained": Kind(("latent", "architecture", "seed"), _untrained),
    "ae": Kind(_TRAINED, None),
    "dae": Kind((*_TRAINED, "noise"), None),
}


def get_kind(name: str) -> Kind:
    """The kind of encoder of that name.

    Raises:
        InputError: the name is unknown; the message lists the kinds.
    """
    return choose(name, KINDS, "kind")


class Fitted(NamedTuple):
    """An encoder in its file."""

    encoder: Encoder
    path: Path
    is_new: bool  # False if the file was complete already


class Fitter:
    """Makes encoders from one data set, in one folder.

    The encoder `dae-8` is the file `dae-8.safetensors` there; the folder `dae-8.training` beside it
    has TensorBoard's scalars and, until training is finished, the checkpoint to resume from.

    Args:
        data: to learn from.
        folder: created if it doesn't exist.
        device: to train on: cpu, cuda, or auto.
        memory: bytes that training rows may take: more are read from disk in each epoch, to the
            same file; None for half of what is free.
    """

    def __init__(
        self,
        data: ScaledDataset,
        folder: Path,
        device: str = "auto",
        memory: int | None = None,
    ):
        self._data = data
        self._folder = folder
        self._device = get_device(device)
        self._memory = memory

    def fit(self, kind: str, training: Training) -> Fitted:
        """Make an encoder, unless its file is complete already.

        An interrupted training leaves its best parameters so far in the file, and its checkpoint,
        from which the same call resumes.

        Raises:
            InputError: as `check`, or the files can't be written.
        """
        header, path = self._plan(kind, training)
        complete = _is_complete(path, header)
        if not complete:
            make_folder(self._folder)
            if make := KINDS[kind].make:
                self._save(header, make(self._data, **header["training"]), path, {})
            else:
                complete = self._train_alone(header, training, path)
        return Fitted(load(path), path, not complete)

    def check(self, kind: str, training: Training) -> bool:
        """Make sure that an encoder can be made, and say whether its file is complete already.

        Raises:
            InputError: an unknown kind, a latent size out of range, or a file that was made with
                other settings or from other data.
        """
        header, path = self._plan(kind, training)
        return _is_complete(path, header)

    def _plan(self, kind: str, training: Training) -> tuple[dict[str, Any], Path]:
        """The header and the file of an encoder, once its settings have been checked."""
        settings = {name: getattr(training, name) for name in get_kind(kind).settings}
        if "batch_size" in settings:
            settings["batch_size"] = training.batch_size or default_batch_size(
                len(self._data.train)
            )
        _check(kind, settings, self._data)
        header = self._header(kind, settings)
        return header, self._folder / f"{header['name']}{SUFFIX}"

    def _header(self, kind: str, settings: dict[str, Any]) -> dict[str, Any]:
        """The header of an encoder, without its metrics."""
        manifest = self._data.dataset.manifest
        parts = {name: settings[name] for name in ("architecture", "latent") if name in settings}
        return {
            "kind": kind,
            "name": str(EncoderName(kind, **parts)),
            "task": self._data.task.name,
            "environment": self._data.task.as_json(),
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
            "commits": dict(commits()),
        }

    def _train_alone(self, header: dict[str, Any], training: Training, path: Path) -> bool:
        """Train while no other process does, unless one has finished it; whether one has."""
        work = path.with_suffix(".training")
        make_folder(work)
        with exclusive(work):
            complete = _is_complete(path, header)
            if not complete:
                settings = {"noise": 0, **header["training"]}
                self._train(header, replace(training, **settings), path, work)
        return complete

    def _train(self, header: dict[str, Any], training: Training, path: Path, work: Path) -> None:
        """Train from the checkpoint, if there is one, or from the start."""
        trainer = Trainer(training, *self._rows)
        versions = {"device": self._device.type, "torch": header["versions"]["torch"]}
        identity = {**_origin(header), **versions}
        saved = work / "checkpoint.safetensors"
        if exists(saved):
            checkpoint.restore(trainer, identity, saved)
        try:
            with SummaryWriter(str(work), purge_step=len(trainer.history) + 1) as scalars:
                for _ in _with_progress(trainer, header["name"]):
                    checkpoint.save(trainer, identity, saved)
                    for name, value in trainer.history[-1]._asdict().items():
                        scalars.add_scalar(name, value, len(trainer.history))
        finally:
            if trainer.history:
                self._save_best(header, trainer, path)
        saved.unlink()

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
        """Write the file, with the error on all held-out rows among its metrics."""
        encoder = Encoder(header, self._data.scaler, *parts)
        error = held_out_error(encoder, self._data)
        save(replace(encoder, header={**header, "metrics": {**metrics, HELD_OUT_MSE: error}}), path)

    @cached_property
    def _rows(self) -> tuple[Rows, Tensor]:
        """Training rows, and a sample of the held-out ones, on the device."""
        train = training_rows(self._data, self._device, self._memory)
        return train, watched_rows(self._data, self._device)


def _check(kind: str, settings: Mapping[str, Any], data: ScaledDataset) -> None:
    """Make sure that an encoder of that kind, with those settings, can be made from the data.

    Raises:
        InputError: it can't.
    """
    size = data.task.size
    try:
        Encoder({"name": kind}, data.scaler, (), ())
    except InputError as error:
        raise InputError(
            f"the observations in {data.dataset.folder} are too large to be encoded: {error}"
        ) from None
    if "latent" in settings:
        latent = settings["latent"]
        if size == 1:
            raise InputError(
                f"{data.task.name} has one feature, which can't be reduced: use {FULL}"
            )
        if latent is None:
            raise InputError(f"{kind} needs a latent size, from 1 to {size - 1}")
        if not 1 <= latent < size:
            raise InputError(
                f"latent size is {latent}: with {size} features it must be from 1 to {size - 1}"
            )
        if "architecture" in settings:
            check_size(get_architecture(settings["architecture"]), size, latent)
    if settings.get("noise") == 0:
        raise InputError(f"{kind} without noise is a plain autoencoder: use the kind ae")


def _is_complete(path: Path, header: Mapping[str, Any]) -> bool:
    """Whether the file holds that encoder, trained to the end; False if there is no file.

    Raises:
        InputError: the file was made with other settings or from other data.
    """
    if not exists(path):
        return False
    there, wanted = load(path).header, _origin(header)
    if differing := differences(_origin(there), wanted):
        raise InputError(
            f"{path} was trained with other settings: {differing}; choose another folder, or "
            "delete it"
        )
    return there["metrics"].get("epochs") == wanted.get("epochs")


def _origin(header: Mapping[str, Any]) -> dict[str, Any]:
    """What must be equal for two encoders of one name to be the same."""
    data = header["data"].get("fingerprint")
    return {**header["training"], "kind": header["kind"], "task": header["task"], "data": data}


def _with_progress(trainer: Trainer, name: str) -> Iterator[Epoch]:
    """The epochs still to train, with a progress bar."""
    total, done = trainer.training.epochs, len(trainer.history)
    with Progress(total=total, initial=done, desc=name, unit="epoch") as progress:
        for epoch in trainer.epochs():
            progress.set_postfix(train=f"{epoch.train_loss:.5f}", test=f"{epoch.test_loss:.5f}")
            progress.update()
            yield epoch
