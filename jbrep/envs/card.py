"""A task on one screen."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from jbrep.text import counted, facts, table

if TYPE_CHECKING:
    from jbrep.envs.task import Feature, Task

_MOST_FEATURES = 60  # shown


def card(task: "Task", width: int = 80) -> str:
    """What a task is, as text of at most `width` columns."""
    shown = task.features[:_MOST_FEATURES]
    parts = [f"{task.name}\n{facts(dict(_facts(task)), width)}"]
    parts.append(table(("feature", "unit", "usual range", "kind"), map(_cells, shown), width))
    if len(shown) < task.size:
        parts.append(f"... and {task.size - len(shown):,} more; --json lists all")
    return "\n\n".join(parts)


def _facts(task: "Task") -> Iterator[tuple[str, str]]:
    if task.name != task.id:
        yield "id", task.id
    if task.arguments:
        yield "arguments", ", ".join(task.given_arguments)
    yield "observation", counted(task.size, "feature")
    bounds = map(range_text, task.action_low, task.action_high)
    yield "action", f"{counted(task.action_size, 'number')} in {', '.join(dict.fromkeys(bounds))}"
    if task.action_names:
        yield "actions", ", ".join(task.action_names)
    step = "" if task.timestep is None else f" of {task.timestep:g} s"
    yield "time limit", f"{task.max_episode_steps:,} steps{step}"
    if task.terminates is None:
        yield "terminates", "not within the few episodes that were tried"
    else:
        yield "terminates", "yes: a state can end an episode" if task.terminates else "no"
    if task.reward_low is not None or task.reward_high is not None:
        yield "reward", f"in {range_text(task.reward_low, task.reward_high)}"
    if task.solved_return is not None:
        yield "solved", f"from a return of {task.solved_return:,g}"
    if task.state:
        yield "states", ", ".join(f"{name} ({width})" for name, width in task.state.items())
    found = "with the same seed and actions a fresh and a used instance"
    if task.reproducible:
        yield "reproducible", f"yes: {found} give the same bits"
    else:
        lost = "data sets can't be replayed and stopped runs can't be resumed"
        yield "reproducible", f"no: {found} differ, so {lost}"


def range_text(low: float | None, high: float | None) -> str:
    """Limits, of which either may be unknown, for people: [-1, inf]."""
    ends = ["-inf" if low is None else f"{low:g}", "inf" if high is None else f"{high:g}"]
    return f"[{', '.join(ends)}]"


def _cells(feature: "Feature") -> tuple[str, ...]:
    known = feature.low is not None or feature.high is not None
    usual = range_text(feature.low, feature.high) if known else "-"
    kind = ", ".join(filter(None, (feature.kind, feature.frame)))
    return feature.name, feature.unit or "-", usual, kind
