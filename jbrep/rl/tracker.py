"""Weights & Biases as a logger of runs."""

import hashlib
import json
import sys
from numbers import Real
from pathlib import Path
from typing import Any

import wandb
from stable_baselines3.common.logger import KVWriter

from jbrep.errors import first_line
from jbrep.records.record import to_plain
from jbrep.rl.run_settings import RunSettings

TENSORBOARD = "tensorboard"  # what is kept from it is kept from here, too


class Tracker(KVWriter):
    """Logs to Weights & Biases what TensorBoard gets, from the first record on.

    Whatever goes wrong there is said once, in a line, and the run goes on. The environment's
    WANDB_MODE decides whether it is online, offline or disabled.

    Args:
        project: of Weights & Biases.
        folder: of the run; its name is the run's there, and files are kept in it.
        settings: of the run.
    """

    def __init__(self, project: str, folder: Path, settings: RunSettings):
        self._project, self._folder, self._settings = project, folder, to_plain(settings)
        self._run: Any = None
        self._failed = False

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Log the numbers of a step of training."""
        numbers = {
            name: float(value)
            for name, value in key_values.items()
            if isinstance(value, Real) and TENSORBOARD not in (key_excluded[name] or ())
        }
        if self._failed:
            return
        try:
            self._run = self._run or self._begin()
            self._run.log({**numbers, "step": step})
        except Exception as error:  # of its many kinds none may end a run
            self._failed = True
            reason = first_line(error)
            print(f"Weights & Biases: {reason}; the run goes on without it", file=sys.stderr)

    def close(self) -> None:
        """End the run there."""
        if self._run and not self._failed:
            try:
                self._run.finish()
            except Exception:  # the run's own files are complete
                self._failed = True

    def _begin(self) -> Any:
        text = json.dumps([self._project, str(self._folder), self._settings], sort_keys=True)
        return wandb.init(
            project=self._project,
            name=self._folder.name,
            id=hashlib.sha256(text.encode()).hexdigest()[:16],  # that a resumed run finds again
            resume="allow",
            config=self._settings,
            dir=str(self._folder),
            settings=wandb.Settings(silent=True, console="off"),
        )
