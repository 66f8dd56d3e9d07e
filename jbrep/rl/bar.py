"""The progress of a run as a line."""

from collections.abc import Sequence
from typing import Any

from jbrep.progress import Progress
from jbrep.rl.history import History
from jbrep.text import rounded, sparkline

_LINE = "{desc}: {n_fmt}/{total_fmt}, {rate_fmt}, {remaining} left{postfix}"  # on a terminal
_NAME, _CURVE = 16, 10  # letters and blocks in it, at most


class Bar:
    """A line of progress, from the step on at which the run starts or resumes.

    On a terminal it has a curve of the evaluations' mean returns, and fits 80 columns.
    """

    def __init__(self, steps: int, name: str):
        self._steps = steps
        self._name = name if len(name) <= _NAME else f"{name[: _NAME - 3]}..."
        self._progress: Any = None

    def show(self, history: History, step: int) -> None:
        """Show the steps so far and the mean returns of the evaluations.

        The final evaluation can take minutes: all steps are told before it, and after it again.
        """
        if self._progress is None:
            self._progress = Progress(
                total=self._steps,
                initial=step,
                desc=self._name,
                unit="",
                unit_scale=True,
                delay=0.5,
                bar_format=_LINE,
            )
        is_final = self._progress.n < self._steps <= step
        self._progress.update(min(step, self._steps) - self._progress.n)
        shown = "final ones under way" if is_final else self._course(history.means)
        self._progress.set_postfix(returns=shown, refresh=is_final)

    def _course(self, means: Sequence[float]) -> str:
        """The last mean return, after a curve of all where there are Unicode's blocks."""
        if not means:
            return "-"
        curve = "" if self._progress.ascii else sparkline(means, _CURVE)
        return f"{curve} {rounded(means[-1])[0]}".strip()

    def close(self) -> None:
        """End the line."""
        if self._progress is not None:
            self._progress.close()
