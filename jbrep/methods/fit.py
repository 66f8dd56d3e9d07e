"""Making encoders by every method from a data set, each in its file."""

from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.tensorboard import SummaryWriter

from jbrep.coordinates import OBSERVATION
from jbrep.coordinates.invariance import tried_coordinates
from jbrep.dataset import Dataset, ScaledDataset
from jbrep.dataset.scaled import Moments
from jbrep.dataset.scaling import EXTREMA
from jbrep.encoders import Encoder, load, save
from jbrep.encoders.encoder import SUFFIX
from jbrep.encoders.header import HELD_OUT_MSE, EncoderHeader, check_name
from jbrep.encoders.layers import dense, run
from jbrep.encoders.shipped import UNLEARNED
from jbrep.envs.task import Array
from jbrep.errors import InputError, differences
from jbrep.methods.linear import DEVIATION, NEGLIGIBLE, held_out_error
from jbrep.methods.registry import get_method, name_of
from jbrep.records.commit import commits
from jbrep.records.record import to_plain
from jbrep.records.storage import exclusive, exists, make_folder
from jbrep.training.method import USUAL, ClosedForm, Learned, Made, Method
from jbrep.training.objective import Layers
from jbrep.training.trainer import Trainer, default_batch_size, get_device, single_thread
from jbrep.training.windows import Windows, count_windows, watched_windows

_NOTHING = 1e-12  # variance of a unit that says nothing


class Fitted(NamedTuple):
    """An encoder in its file."""

    encoder: Encoder
    path: Path
    is_new: bool  # False if the file was complete already

    def __repr__(self) -> str:
        lost = self.encoder.header.metrics[HELD_OUT_MSE]
        return (
            f"{self.encoder.name}: reconstructs held-out states with a mean squared error of "
            f"{lost:.5f}, of features scaled to [-1, 1]; {self.path}"
            f"{'' if self.is_new else ', already complete'}"
        )


class FitPlan(NamedTuple):
    """An encoder that can be made: its settings have been checked."""

    method: Method
    data: ScaledDataset  # scaled as the method says
    header: EncoderHeader  # without metrics
    path: Path

    def find(self) -> Encoder | None:
        """The encoder in the file, perhaps not yet trained to the end; None if there is no file."""
        if not exists(self.path):
            return None
        encoder = load(self.path)
        if differing := differences(_origin(encoder.header), _origin(self.header)):
            raise InputError(
                f"{self.path} was made with other settings: {differing}; choose another folder or "
                "another name, or delete it"
            )
        return encoder

    def is_complete(self) -> bool:
        """Whether the file holds this encoder, trained to the end."""
        encoder = self.find()
        epochs = self.method.epochs if isinstance(self.method, Learned) else None
        return encoder is not None and encoder.header.metrics.get("epochs") == epochs


class Fitter:
    """Makes encoders from one data set, in one folder.

    The encoder `dae-8` is the file `dae-8.safetensors` there; the folder `dae-8.training` beside it
    has TensorBoard's scalars and, until training is finished, the checkpoint to resume from.
    """

    def __init__(
        self, data: ScaledDataset | Dataset | str | Path, folder: Path, device: str = "auto"
    ):
        self._data = ScaledDataset.of(data)
        self._folder = folder
        self._device = get_device(device)
        self._scaled: dict[Any, ScaledDataset] = {}
        self._windows: dict[tuple[ScaledDataset, int], tuple[Windows, Windows]] = {}

    def fit(self, kind: str, *, name: str | None = None, **settings: Any) -> Fitted:
        """Make an encoder by the method `kind`, unless its file is complete already.

        An interrupted training leaves its best parameters so far in the file, and its checkpoint,
        from which the same call resumes. Settings are text or values.
        """
        with single_thread():
            plan = self.plan(kind, name=name, **settings)
            is_new = not plan.is_complete() and self._make_once(plan)
        return Fitted(load(plan.path), plan.path, is_new)

    def plan(self, kind: str, *, name: str | None = None, **settings: Any) -> FitPlan:
        """What `fit` would make."""
        method = get_method(kind).of(settings)
        data = self._scaled_data(method)
        method = method.resolved(data)
        name = name or name_of(method)
        check_name(name)
        if name in UNLEARNED and name != method.name:
            raise InputError(f"`name` is {name}, as an encoder that needs no data is called")
        method.check_data(data)
        if isinstance(method, Learned):
            windows = count_windows(data, method.objective(data).horizon)
            if not method.batch_size:
                method = method.replace(batch_size=default_batch_size(windows))
        plan = FitPlan(method, data, _header(method, name, data), self._folder / f"{name}{SUFFIX}")
        plan.find()  # another encoder there is a mistake
        return plan

    def _scaled_data(self, method: Method) -> ScaledDataset:
        key = method.scaling, method.on, method.leave_out, method.clip, method.keep
        if key not in self._scaled:
            usual = (EXTREMA, OBSERVATION, (), None, ())
            self._scaled[key] = self._data if key == usual else self._rescaled(method)
        data = self._scaled[key]
        try:
            header = EncoderHeader(kind=method.name, name=method.name, environment=data.task)
            Encoder(header, data.scaler, (), ())
        except InputError as error:
            raise InputError(
                f"the observations in {data.dataset.folder} are too large to be encoded: {error}"
            ) from None
        return data

    def _rescaled(self, method: Method) -> ScaledDataset:
        coordinates = tried_coordinates(self._data.task, method.on, method.leave_out)
        return self._data.rescaled(method.scaling, coordinates, method.clip, method.keep)

    def _make_once(self, plan: FitPlan) -> bool:
        make_folder(self._folder)
        with exclusive(plan.path, beside=True):
            if plan.is_complete():
                return False
            self._make(plan)
            return True

    def _make(self, plan: FitPlan) -> None:
        match plan.method:
            case ClosedForm() as method:
                self._save(plan, method.make(plan.data))
            case Learned() as method:
                self._train(plan, method)

    def _train(self, plan: FitPlan, method: Learned) -> None:
        work = plan.path.with_suffix(".training")
        make_folder(work)
        header, objective = plan.header, method.objective(plan.data).to(self._device)
        windows, watched = self._windows_of(plan.data, objective.horizon)
        trainer = Trainer(objective, method, windows, watched)
        versions = {"device": self._device.type, "torch": header.versions["torch"]}
        identity = {**_origin(header), **versions}
        saved = work / "checkpoint.safetensors"
        if exists(saved):
            trainer.restore(identity, saved)
        try:
            with SummaryWriter(str(work), purge_step=len(trainer.history) + 1) as scalars:
                for _ in trainer.with_progress(header.name):
                    for name, value in trainer.history[-1]._asdict().items():
                        scalars.add_scalar(name, value, len(trainer.history))
                    trainer.save(identity, saved)
        finally:
            if trainer.history:
                self._save_best(plan, trainer, watched)
        saved.unlink()

    def _windows_of(self, data: ScaledDataset, horizon: int) -> tuple[Windows, Windows]:
        key = data, horizon
        if key not in self._windows:
            train = Windows(data, data.train, horizon, self._device)
            self._windows = {key: (train, watched_windows(data, horizon, self._device))}
        return self._windows[key]

    def _save_best(self, plan: FitPlan, trainer: Trainer, watched: Windows) -> None:
        objective = trainer.objective
        objective.load_state_dict(trainer.best)
        best = trainer.best_epoch
        metrics = {
            "epochs": len(trainer.history),
            "best_epoch": best,
            "train_loss": trainer.history[best - 1].train_loss,
            "test_loss": trainer.history[best - 1].test_loss,
        }
        objective.eval()
        with torch.no_grad():
            metrics |= objective.report(watched)
            self._save(plan, Made(*objective.layers(), metrics))

    def _save(self, plan: FitPlan, made: Made) -> None:
        method, data = plan.method, plan.data
        parts = complete(made, data, method.codes, method.keep)
        encoder = Encoder(plan.header, data.scaler, *parts)
        metrics = {**made.metrics, HELD_OUT_MSE: held_out_error(encoder, self._data)}
        save(encoder.with_header(metrics=metrics), plan.path)


def _header(method: Method, name: str, data: ScaledDataset) -> EncoderHeader:
    manifest = data.dataset.manifest
    return EncoderHeader(
        kind=method.name,
        name=name,
        environment=data.task,
        training=method.training,
        data={
            "fingerprint": data.dataset.fingerprint,
            "policy": dict(manifest.settings.policy),
            "seed": manifest.settings.seed,
            "train_rows": len(data.train),
            "test_rows": len(data.test),
        },
        versions={each: version(each) for each in ("jbrep", "numpy", "torch")},
        commits=dict(commits()),
    )


def _origin(header: EncoderHeader) -> dict[str, Any]:
    """What must be equal for two encoders of one name to be the same."""
    task = header.environment
    of = {"kind": header.kind, "task": task.name, "features": to_plain(task.features)}
    return {**USUAL, **header.training, **of, "data": header.data.get("fingerprint")}


def complete(
    made: Made, data: ScaledDataset, codes: str = "raw", keep: tuple[str, ...] = ()
) -> tuple[Layers, Layers, tuple[str, ...]]:
    """An encoder's layers, its decoder's, and the features that pass around them.

    What a method made gets the scale of its code and, if it has none, a linear decoder. `keep`
    names what passes around the layers, unless the method says which.
    """
    encoder, decoder = made.encoder, made.decoder
    if not encoder:
        return encoder, (), ()
    if codes != "raw" or decoder is None:
        moments, shared = _code_moments(encoder, data)
        if decoder is None:
            weight = shared.T @ np.linalg.pinv(moments.covariance, hermitian=True)
            decoder = (dense(weight, data.moments.mean - weight @ moments.mean),)
        if codes != "raw":
            encoder, decoder = _rescaled(encoder, decoder, moments, codes)
    if data.size < data.scaler.size:
        encoder, decoder = _widened(encoder, decoder, data)
    every = data.scaler.features(data.task)
    kept = tuple(every[i].name for i in data.scaler.places(keep, data.task))
    return encoder, decoder, made.keep or kept


def _code_moments(layers: Layers, data: ScaledDataset) -> tuple[Moments, Array]:
    size = len(layers[-1].bias)
    total, products = np.zeros(size), np.zeros((size, size + data.size))
    for rows in data.chunks(data.train):
        code = run(layers, rows).astype(np.float64)
        total += code.sum(axis=0)
        products += code.T @ np.hstack((code, rows))
    count = len(data.train)
    mean = total / count
    covariance = products / count - np.outer(mean, np.concatenate((mean, data.moments.mean)))
    return Moments(mean, covariance[:, :size]), covariance[:, size:]


def _rescaled(
    encoder: Layers, decoder: Layers, moments: Moments, codes: str
) -> tuple[Layers, Layers]:
    """The same code with standard deviation 1/3 in each unit, uncorrelated if it is to be white."""
    mean, covariance = moments
    axes, variance, least = np.eye(len(mean)), np.diag(covariance), _NOTHING
    if codes == "white":  # units may depend on others, but for rounding
        variance, axes = np.linalg.eigh(covariance)
        least = NEGLIGIBLE * variance[-1]
    varies = variance > least
    scale = axes * np.where(varies, DEVIATION / np.sqrt(np.where(varies, variance, 1)), 1) @ axes.T
    return _after(encoder, scale, -scale @ mean), _before(decoder, np.linalg.inv(scale), mean)


def _after(layers: Layers, weight: Array, bias: Array) -> Layers:
    last = layers[-1]
    if last.activation != "linear":
        return (*layers, dense(weight, bias))
    return (*layers[:-1], dense(weight @ last.weight, weight @ last.bias + bias))


def _before(layers: Layers, weight: NDArray[Any], bias: Array) -> Layers:
    first = layers[0]
    both = dense(first.weight @ weight, first.weight @ bias + first.bias, first.activation)
    return (both, *layers[1:])


def _widened(encoder: Layers, decoder: Layers, data: ScaledDataset) -> tuple[Layers, Layers]:
    """Layers that take and give all scaled numbers, not only those that are used.

    The others count nothing in the encoder, and come out as 0.
    """
    size, used = data.scaler.size, data.used
    first, last = encoder[0], decoder[-1]
    takes = np.zeros((len(first.bias), size), np.float32)
    takes[:, used] = first.weight
    gives, bias = np.zeros((size, last.weight.shape[1]), np.float32), np.zeros(size, np.float32)
    gives[used], bias[used] = last.weight, last.bias
    return (
        (first._replace(weight=takes), *encoder[1:]),
        (*decoder[:-1], last._replace(weight=gives, bias=bias)),
    )
