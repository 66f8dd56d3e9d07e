"""What an encoder is to all stages, and users' own encoders: objects and torch modules."""

import hashlib
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jbrep.envs.task import Task
from jbrep.errors import InputError, kind_and_line, refusing

Float32 = NDArray[np.float32]

OWN = "own"  # the kind of a user's own encoder
_NAME = re.compile(r"[\w.-]{1,100}", re.ASCII)
_PROBES = 256  # observations by whose latents an own encoder is known
_SAME = 1e-2  # by which a latent may differ in another batch, of the largest: rounding, TF32


class BaseEncoder(ABC):
    """What every stage uses of an encoder."""

    name: str  # what tables call it
    kind: str  # how it was made, such as dae, pca, full, own
    task: Task  # whose observations it reads
    size: int  # length d of an observation
    latent_size: int  # length l of a latent
    can_decode: bool  # whether `decode` is possible
    fingerprint: str  # SHA-256 that identifies it

    def __repr__(self) -> str:
        kind = type(self).__name__
        return f"{kind}({self.name}, {self.task.name}, {self.size} to {self.latent_size})"

    @property
    def not_decoded(self) -> tuple[str, ...]:
        """Features that symmetry leaves out, such as position: decoded, they are 0."""
        return ()

    def comparable(self, decoded: Any, observation: Any) -> Any:
        """What was decoded, (n, d), in the numbers in which it can be compared with observations.

        These are its own but for codes on coordinates, which don't tell a quaternion's sign and
        whole turns: theirs are those nearest to the observation.
        """
        return decoded

    @abstractmethod
    def encode(self, observation: Any) -> Any:
        """Encode observations (..., d) in physical units as latents (..., l)."""

    @abstractmethod
    def decode(self, latent: Any) -> Any:
        """Decode latents (..., l) to observations (..., d) in physical units."""

    def check_decodes(self, why: str) -> None:
        """Make sure that it can decode, where that is needed."""
        if not self.can_decode:
            raise InputError(f"{self.name} has no decoder: {why}")

    def scale(self, observation: Any) -> Any:
        """Scale observations (..., d) to about [-1, 1], so that errors of features compare."""
        return self.task.scale(observation)

    @abstractmethod
    def check_task(self, task: Task) -> None:
        """Make sure that it can read this task's observations."""


def as_encoder(given: Any, task: Task) -> BaseEncoder:
    """An encoder of jbrep, or whatever else encodes (see `OwnEncoder`), for a task."""
    encoder = given if isinstance(given, BaseEncoder) else OwnEncoder(given, task)
    encoder.check_task(task)
    return encoder


class OwnEncoder(BaseEncoder):
    """A user's own encoder.

    It gets float32 observations (n, d) in physical units and returns latents (n, l), each of which
    depends on its own observation alone. Both are copied, so that it may do as it likes with them.

    Args:
        given: an object with `encode`, a fitted transformer of scikit-learn, or else something that
            is called, such as a function or a torch module, which gets a tensor on its own device,
            in evaluation mode and without gradients. `latent_size`, `decode`, `name` and
            `check_task` are used if there are any.
        task: whose observations it reads.
    """

    kind = OWN

    def __init__(self, given: Any, task: Task):
        self.task, self.size = task, task.size
        self.name = _name(given)
        if isinstance(given, type):
            raise InputError(f"{self.name} is a class: give an object, such as {self.name}()")
        self.given = given
        self._encode = getattr(given, "encode", None) or getattr(given, "transform", given)
        self._decode: Any = getattr(given, "decode", None) or getattr(
            given, "inverse_transform", None
        )
        self.can_decode = callable(self._decode)
        if not callable(self._encode):
            raise InputError(
                f"{self.name} has neither `encode` nor `transform` and can't be called: it is no "
                "encoder"
            )
        latents = self._apply(self._encode, self._probes, None)
        self.latent_size = latents.shape[1]
        if (declared := getattr(given, "latent_size", self.latent_size)) != self.latent_size:
            raise InputError(
                f"{self.name} returned latents of {self.latent_size} numbers, but its latent_size "
                f"is {declared}"
            )
        self._check_repeats(latents)
        self.fingerprint = hashlib.sha256(latents.tobytes()).hexdigest()

    @property
    def _probes(self) -> Float32:
        scaled = np.random.default_rng(0).uniform(-1, 1, (_PROBES, self.size))  # usual ranges
        return self.task.unscale(scaled).astype(np.float32)

    def _check_repeats(self, latents: Float32) -> None:
        """Refuse it unless the probes' latents (n, l) come again, in this batch and in another."""
        near = _SAME * np.abs(latents).max()
        for count, when in ((_PROBES, "the next time"), (1, "in a batch of one")):
            again = self._apply(self._encode, self._probes[:count], self.latent_size)
            if not np.allclose(again, latents[:count], rtol=_SAME, atol=near):
                raise InputError(
                    f"{self.name} returned other latents for the same observations {when}: an "
                    "encoder must be deterministic, keep no state, and encode each row by itself"
                )

    def encode(self, observation: Any) -> Float32:
        return self._in_rows(self._encode, observation, self.size, self.latent_size)

    def decode(self, latent: Any) -> Float32:
        self.check_decodes("it can't reconstruct observations")
        return self._in_rows(self._decode, latent, self.latent_size, self.size)

    def check_task(self, task: Task) -> None:
        if check := getattr(self.given, "check_task", None):
            with refusing(f"{self.name} refuses {task.name}", describe=_reason):
                check(task)
        elif task.size != self.size:
            raise InputError(
                f"{self.name} takes observations of {self.size} numbers, but {task.name} has "
                f"{task.size}"
            )

    def _in_rows(self, function: Callable[..., Any], values: Any, size: int, width: int) -> Float32:
        values = np.asarray(values, np.float32)
        if not values.ndim or values.shape[-1] != size:
            raise InputError(
                f"{self.name} takes {size} numbers, but got an array of shape {values.shape}"
            )
        if not values.size:
            return np.empty((*values.shape[:-1], width), np.float32)
        result = self._apply(function, values.reshape(-1, size), width)
        return result.reshape(*values.shape[:-1], width)

    def _apply(self, function: Callable[..., Any], rows: Float32, width: int | None) -> Float32:
        """What the user's function makes of rows, (n, width), checked; of any width if None."""
        try:
            result = _as_array(self._call(function, rows.copy()))
        except Exception as error:
            raise InputError(f"{self.name} failed: {_reason(error)}") from error
        if result.ndim != 2 or result.shape != (len(rows), width or result.shape[1]):
            raise InputError(
                f"{self.name} returned shape {result.shape} for {len(rows)} rows of "
                f"{self.task.name}: expected ({len(rows)}, {width or 'its latent size'})"
            )
        if not result.shape[1]:
            raise InputError(f"{self.name} returned latents of no numbers: expected at least one")
        if not np.isfinite(result).all():
            raise InputError(f"{self.name} returned numbers that are not finite")
        return result

    def _call(self, function: Callable[..., Any], rows: Float32) -> Any:
        torch, pandas = sys.modules.get("torch"), sys.modules.get("pandas")
        if torch and isinstance(self.given, torch.nn.Module):
            tensors = chain(self.given.parameters(), self.given.buffers())
            like = next((t for t in tensors if t.is_floating_point()), torch.empty(0))
            with _evaluating(self.given), torch.no_grad():
                return function(torch.from_numpy(rows).to(like.device, like.dtype))
        names = getattr(self.given, "feature_names_in_", None)
        if pandas and names is not None and function is self._encode:
            return function(pandas.DataFrame(rows, columns=names))  # as it was fitted
        return function(rows)


@contextmanager
def _evaluating(module: Any) -> Iterator[None]:
    training = [part for part in module.modules() if part.training]
    for part in training:
        part.training = False
    try:
        yield
    finally:
        for part in training:
            part.training = True


def _name(given: Any) -> str:
    for name in (getattr(given, "name", None), getattr(given, "__name__", None)):
        if isinstance(name, str) and _NAME.fullmatch(name):
            return name
    return type(given).__name__


def _as_array(result: Any) -> Float32:
    if isinstance(result, (tuple, dict)):
        raise TypeError(f"it returned a {type(result).__name__} instead of one array")
    if hasattr(result, "detach"):
        result = result.detach().cpu().float().numpy()
    with np.errstate(over="ignore"):  # infinite numbers are refused
        return np.array(result, np.float32)


def _reason(error: Exception) -> str:
    text = kind_and_line(error)
    return f"{text} (an encoder runs without gradients)" if "grad" in text else text
