"""Policies for a robot: a file that any runtime of ONNX, or torch alone, computes actions with."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jbrep.encoders.encoder import Encoder
from jbrep.encoders.layers import ONNX
from jbrep.errors import InputError, choose
from jbrep.records.record import to_plain
from jbrep.records.storage import exists, taken, write_new
from jbrep.rl.controller import Controller


def export(controller: Controller, path: Path, form: str = "onnx") -> None:
    """Write a policy as one model from observations, as the robot gives them, to actions.

    Its input is `observation`, (rows, d) float32 in the units of the task's features; its output is
    `action`, (rows, k) in those of the actuators. `described` is in its metadata, as `jbrep`. Each
    action is to be held for `action_repeat` control steps, which is for the caller to do, as is
    keeping the states and actions of the steps before for a policy that was trained with a history.

    Args:
        controller: of the policy.
        path: a new file.
        form: onnx, or torch for a program of torch.export (.pt2).
    """
    write = choose(form, _FORMS, "format")
    if not isinstance(controller.encoder, Encoder):
        raise InputError(
            f"the encoder {controller.encoder.name} is code, which a model can't hold: give the "
            "run an encoder's file, as Encoder.from_torch makes it"
        )
    if exists(path):  # known before the work
        raise taken(path)
    write_new(path, write(controller))


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
    return bytes(model.SerializeToString(deterministic=True))


def _torch(controller: Controller) -> bytes:
    import io

    import torch

    encoder, acting = controller.encoder, controller.acting.in_torch()
    assert isinstance(encoder, Encoder)
    if any(layer.activation == ONNX for layer in encoder.encoder):
        raise InputError(
            f"the encoder {encoder.name} is an ONNX model, which torch can't hold: choose the "
            "format onnx"
        )

    class Policy(torch.nn.Module):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            return acting.actions(encoder.encode(observation))

    rows = torch.export.Dim("rows")
    program = torch.export.export(
        Policy(), (torch.zeros(2, controller.task.size),), dynamic_shapes=({0: rows},)
    )
    content = io.BytesIO()
    metadata = {"jbrep": json.dumps(described(controller))}
    torch.export.save(program, content, extra_files=metadata)
    return content.getvalue()


_FORMS: dict[str, Callable[[Controller], bytes]] = {"onnx": _onnx, "torch": _torch}
