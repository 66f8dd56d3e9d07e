"""Trained policies for a robot: functions of what its sensors say, in NumPy alone, and files.

Any runtime of ONNX computes actions with such a file.
"""

import hashlib
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jbrep.coordinates import library_of
from jbrep.encoders.base import BaseEncoder
from jbrep.encoders.encoder import Encoder, load
from jbrep.encoders.layers import ACTIVATIONS, Layer, activate, dense, run
from jbrep.encoders.shipped import find
from jbrep.envs.task import most_held
from jbrep.envs.view import Window
from jbrep.errors import InputError, choose, listed, refusing
from jbrep.records.container import Tensors, without
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, taken, write_new
from jbrep.rl.files import ENCODER, POLICY, POLICY_ZIP, RUN, is_run, read_finished
from jbrep.rl.normalization import CLIP, Statistics
from jbrep.rl.policy_file import PolicyFile, read
from jbrep.rl.presets import ALGORITHMS
from jbrep.rl.run_settings import RunSettings

SEAL, NOT_SEALED = "sha256", "0" * 64  # of an ONNX file, in whose place zeros stand then
EXAMPLE = Path(__file__).parent / "shipped/loop.py"  # a program that runs such a file
_HIDDEN = "latent_pi.", "mlp_extractor.policy_net.", "mu."  # sequences, numbered from 0
_LAST = "mu", "action_net"  # single layers after them


class Acting(NamedTuple):
    """What a policy computes with, written once for NumPy and ONNX."""

    # of what the network sees, if it is normalised by them: `Statistics.arrays`
    statistics: tuple[Any, ...] | None
    # layers to the actions before they are squashed or clipped to [-1, 1]
    network: tuple[Layer, ...]
    # low, high: bounds of the actions, (k,), to which they are scaled then; of each of a chunk
    low: Any
    high: Any
    is_squashed: bool  # whether actions are squashed; others are clipped

    def actions(self, seen: Any) -> Any:
        """Actions (..., k) of latents (..., l): arrays, or rows of a model."""
        if self.statistics:
            mean, rest, deviation = self.statistics
            seen = ((seen - mean - rest) / deviation).clip(-CLIP, CLIP)
        chosen = run(self.network, seen)
        if self.is_squashed:
            chosen = activate("tanh", chosen)
        half, centre = 0.5 * (self.high - self.low), 0.5 * (self.high + self.low)
        action = chosen.clip(-1, 1) * half + centre
        library = library_of(action)
        return library.minimum(library.maximum(action, self.low), self.high)  # despite rounding


class Controller:
    """A trained policy, from a robot's observations to its actions.

    It does all that belongs to the policy: scaling, encoder, running normalisation, network,
    bounds, and holding each action for as many calls as it was trained with.

        controller = jbrep.load_policy("runs/a")
        action = controller(observation)

    It is made of the run's settings and encoder, and of the weights of the part that acts, by
    stable-baselines3's names.

    Attributes:
        task: says what the observation's numbers and the action's are: names, units, ranges.
        encoder: what the network sees is its latent.
        acting: what is computed of that.
        action_repeat: control steps for which an action is held.
        hold: control steps in a row for which the last readings may stand for those that are
            missing: as many as the task's `missing` says, by default none.
    """

    def __init__(
        self,
        settings: RunSettings,
        encoder: BaseEncoder,
        weights: Tensors,
        statistics: Statistics | None = None,
    ):
        self.settings, self.task, self.encoder = settings, settings.environment, encoder
        self.action_repeat = settings.hyperparameters.action_repeat
        self.acting = Acting(
            statistics=statistics.arrays if statistics else None,
            network=network_of(settings, encoder.latent_size, weights),
            low=np.tile(np.array(self.task.action_low, np.float32), settings.chunk),
            high=np.tile(np.array(self.task.action_high, np.float32), settings.chunk),
            is_squashed=ALGORITHMS[settings.algorithm].learns_off_policy,
        )
        view = self.task.view
        self._names = self.task.feature_names[: len(view.places) if view else None]
        self.hold = most_held(self.task.missing or "")
        self.reset()

    def __repr__(self) -> str:
        size, actions = self.task.size, self.task.action_size
        return f"Controller({self.task.name}: {size} numbers to {actions}, {self.encoder.name})"

    def reset(self) -> None:
        """Begin another episode, of any number of robots: the next call chooses an action."""
        self._given: NDArray[np.float32] | None = None  # the last observation, with what stood in
        self._chunk: NDArray[Any] = np.empty(0)  # the actions that were chosen at once
        self._held: NDArray[Any] = np.empty(0)  # the one of them since then
        self._missed: NDArray[np.int64] = np.zeros(1, np.int64)  # steps in a row, of each robot
        self._first = self._step = self._choice = 0
        self._window: Window | None = None

    def __call__(
        self, observation: ArrayLike | None, step: int | None = None
    ) -> NDArray[np.float32]:
        """The action (k,) at an observation (d,) in the units of the task's features, less offsets.

        Several robots may be given at once, (n, d), for (n, k), the same until `reset`. A policy
        that was trained with a history keeps it: give what the robot shows now. What is refused
        changes nothing: the next call goes on from the one before.

        Args:
            observation: None where none came in time; NaN stands for a reading that is missing.
                Those of the step before stand in, for at most `hold` steps in a row.
            step: the number of this control step; by default the one after the last. Those that
                were left out are steps without an observation, in which the action was held.
        """
        given, begins = self._numbers(observation), self._given is None
        rows, hold = np.atleast_2d(given), 0 if begins else self.hold
        now = step if step is not None else 0 if begins else self._step + 1
        first, left_out = (now, 0) if begins else (self._first, now - self._step - 1)
        if left_out < 0:
            raise InputError(f"step {now} after step {self._step}: reset() the policy first")
        lacking = ~np.isfinite(rows)
        missed = np.where(lacking.any(axis=1), self._missed + left_out + 1, 0)
        if max(left_out, *missed) > hold:
            name = self._names[int(np.argwhere(lacking)[0, -1])] if lacking.any() else "observation"
            raise InputError(
                f"{name} is missing or not finite: the policy's `hold` allows that for {hold} "
                "steps in a row; reset() begins anew"
            )
        if self._given is not None:
            rows = np.where(lacking, np.atleast_2d(self._given), rows)
        window, seen = self._with_history(rows, left_out)
        seen = seen.reshape(*given.shape[:-1], -1)
        choice, part = divmod((now - first) // self.action_repeat, self.settings.chunk)
        if begins or choice != self._choice:
            self._chunk = self._chosen(seen)
        self._held = np.split(self._chunk, self.settings.chunk, axis=-1)[part]
        self._given, self._missed, self._window = rows.reshape(given.shape), missed, window
        self._first, self._step, self._choice = first, now, choice
        return self._held.reshape(*given.shape[:-1], -1).copy()

    def _with_history(
        self, rows: NDArray[np.float32], left_out: int
    ) -> tuple[Window | None, NDArray[np.float32]]:
        if not self.task.view:
            return None, rows
        if self._window is None or self._given is None:
            window = Window(self.task, len(rows), range(len(self._names)))
            seen = window.begin(range(len(rows)), rows)
        else:
            before, moved = np.atleast_2d(self._given), np.ones(len(rows), np.bool_)
            window = deepcopy(self._window)
            for given in (*[before] * left_out, rows):
                seen = window.step(moved, np.atleast_2d(self._held), given)
        return window, seen.astype(np.float32)

    def _numbers(self, observation: ArrayLike | None) -> NDArray[np.float32]:
        """An observation's numbers of now, (d,) or (n, d)."""
        if observation is None and self._given is not None:
            return np.full_like(self._given, np.nan)
        names = self._names
        try:
            given: NDArray[Any] = np.ma.asanyarray(observation)
            if given.dtype.kind not in "fiub" or np.ma.is_masked(given) or not given.size:
                raise TypeError
            given = np.asarray(given, np.float32)
        except (TypeError, ValueError, OverflowError, RuntimeError):
            raise InputError(
                f"the observation is a {type(observation).__name__}: the policy takes {len(names)} "
                "numbers, none of them masked, in one array, as "
                "gymnasium.spaces.flatten(env.observation_space, observation) gives them"
            ) from None
        shape = given.shape  # of now, or with the history that it keeps
        if len(shape) not in (1, 2) or shape[-1] not in (len(names), self.task.size):
            raise InputError(
                f"an observation of shape {shape}: the policy takes {len(names)} numbers, of "
                f"{listed(names)}; or a row of them for each robot"
            )
        if self._given is not None and given[..., 0].size != self._given[..., 0].size:
            before = *self._given.shape[:-1], shape[-1]
            raise InputError(
                f"an observation of shape {shape} after others of {before}: give the same robots, "
                "or reset() the policy first"
            )
        return given[..., : len(names)]

    def _chosen(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        action = self.acting.actions(self.encoder.encode(observation))
        if not np.isfinite(action).all():
            raise InputError(
                "the policy's action is not finite: is its observation in the usual range?"
            )
        return action


def network_of(settings: RunSettings, inputs: int, weights: Tensors) -> tuple[Layer, ...]:
    """The layers of a policy from what it sees to its most likely action, not yet squashed."""
    shape = settings.hyperparameters
    activation = str(shape.policy_kwargs.get("activation_fn")).replace("_", "-")
    choose(activation, ACTIVATIONS, "activation")
    parts = [part for prefix in _HIDDEN for part in _numbered(prefix, weights)]
    parts += [
        {"weight": weights[f"{name}.weight"], "bias": weights[f"{name}.bias"]}
        for name in _LAST
        if f"{name}.weight" in weights
    ]
    layers: list[Layer] = []
    factor, shift = np.ones(inputs), np.zeros(inputs)  # applied to what the next layer takes
    for tensors in parts:
        if "weight" in tensors:
            weight = tensors["weight"].astype(np.float64)
            layers.append(dense(weight * factor, weight @ shift + tensors["bias"], activation))
            factor, shift = np.ones(len(weight)), np.zeros(len(weight))
        else:  # CrossQ's batch renormalisation
            epsilon = shape.policy_kwargs.get("batch_norm_eps", 1e-3)
            deviation = np.sqrt(tensors["ra_var"].astype(np.float64) + epsilon)
            factor = tensors["scale"] / deviation
            shift = tensors["bias"] - tensors["ra_mean"] * factor
    return (*layers[:-1], layers[-1]._replace(activation="linear"))


def _numbered(prefix: str, weights: Tensors) -> list[Tensors]:
    parts: dict[int, Tensors] = {}
    for name, values in without(prefix, weights).items():
        number, _, what = name.partition(".")
        if number.isdecimal():
            parts.setdefault(int(number), {})[what] = values
    return [part for _, part in sorted(parts.items())]


def load_policy(source: str | Path, encoder: Any = None) -> Controller:
    """The policy of a run, as a function of observations.

    Args:
        source: the folder of a run, finished or under way, or a policy's file.
        encoder: the object that the run was made with, if its encoder is a user's own.
    """
    path = Path(source)
    path = path.parent if path.name == POLICY_ZIP and is_run(path.parent) else path
    if path.is_file():
        file = read(path)
        task = file.header.settings.environment
        return _of_file(file, file.encoder() if encoder is None else find(encoder, task))
    if exists(path / RUN) and exists(path / ENCODER) and encoder is None:
        _, sha256 = read_finished(path)
        return _of_file(read(path / POLICY, sha256), load(path / ENCODER))
    from jbrep.rl.agent import acting
    from jbrep.rl.policy import load_run  # imports torch

    trained = load_run(path, encoder)
    weights = {name: each.numpy() for name, each in acting(trained.policy).state_dict().items()}
    return Controller(trained.settings, trained.encoder, weights, trained.statistics)


def _of_file(file: PolicyFile, encoder: BaseEncoder) -> Controller:
    settings, weights = file.header.settings, file.weights
    if encoder.fingerprint != settings.encoder:
        raise InputError(f"{file.path} is of a run on another encoder than {encoder.name}")
    encoder.check_task(settings.environment)
    normalized = settings.hyperparameters.normalize
    with refusing(f"{file.path} doesn't fit the run's settings", (LookupError, ValueError)):
        statistics = Statistics.read(file.tensors, encoder.latent_size) if normalized else None
        return Controller(settings, encoder, weights, statistics)


def export(controller: Controller, path: Path) -> None:
    """Write a policy as one ONNX model from observations, as the robot gives them, to actions.

    Its input is `observation`, (rows, d) float32 in the units of the task's features; its output is
    `action`, (rows, k) in those of the actuators. `described` is in its metadata, as `jbrep`. Each
    action is to be held for `action_repeat` control steps, which is for the caller to do, as is
    keeping the states and actions of the steps before for a policy that was trained with a history,
    and playing the actions of a `chunk`, which stand one after the other in `action`, (rows, chunk
    * k).

    Args:
        controller: of the policy.
        path: a new file.
    """
    if not isinstance(controller.encoder, Encoder):
        raise InputError(
            f"the encoder {controller.encoder.name} is code, which a model can't hold: give the "
            "run an encoder's file, as Encoder.from_torch makes it"
        )
    if path.suffix != ".onnx":
        raise InputError(f"{path} must end in .onnx, by which a policy's model is known")
    if exists(path):  # known before the work
        raise taken(path)
    write_new(path, _onnx(controller))


def described(controller: Controller) -> dict[str, Any]:
    """What a file says of its policy: names, units and ranges, the rate, where it comes from."""
    task, settings = controller.task, controller.settings
    now = task.features[: len(task.view.places)] if task.view else task.features
    period = None if task.timestep is None else task.timestep * controller.action_repeat
    return {
        "task": task.name,
        "environment": to_plain(task),
        "observation": [
            {
                "name": each.name,
                "unit": each.unit,
                "low": each.low,
                "high": each.high,
                "offset": offset,  # subtracted beforehand
            }
            for each, offset in zip(now, task.offset.tolist(), strict=False)
        ],
        "action": {"low": to_plain(task.action_low), "high": to_plain(task.action_high)},
        # of so many states, the newest first, then of the actions between, the input consists
        "history": task.view.history if task.view else 1,
        "control_period": task.timestep,  # seconds
        "action_repeat": controller.action_repeat,
        "chunk": settings.chunk,  # actions that are chosen at once
        "rate": None if period is None else 1 / period,  # actions a second
        "encoder": {"name": controller.encoder.name, "sha256": controller.encoder.fingerprint},
        "learner": settings.learner,
        "steps": settings.steps,
        "seed": settings.seed,
    }


def _onnx(controller: Controller) -> bytes:
    from jbrep.encoders.onnx import traced  # imports onnx

    encoder, acting = controller.encoder, controller.acting
    assert isinstance(encoder, Encoder)

    def outputs(observation: Any) -> Iterator[tuple[str, Any]]:
        yield "action", acting.actions(encoder.arrays.encode(observation))

    model = traced("controller", controller.task.size, outputs, described(controller))
    model.metadata_props.add(key=SEAL, value=NOT_SEALED)
    content: bytes = model.SerializeToString(deterministic=True)
    return content.replace(NOT_SEALED.encode(), hashlib.sha256(content).hexdigest().encode())
