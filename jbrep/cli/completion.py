"""What a shell completes: tasks, kinds of encoders, and the names of those that ship."""

from collections.abc import Callable, Iterable

import click

Complete = Callable[[click.Context, click.Parameter, str], list[str]]


def _completing(names: Callable[[click.Context], Iterable[str]]) -> Complete:
    def complete(context: click.Context, option: click.Parameter, typed: str) -> list[str]:
        return [name for name in names(context) if name.startswith(typed)]

    return complete


def _tasks(context: click.Context) -> Iterable[str]:
    from jbrep.jitterbug.tasks import TASKS

    return TASKS


def _kinds(context: click.Context) -> Iterable[str]:
    from jbrep.methods.kinds import KINDS

    return KINDS


def _shipped(context: click.Context) -> Iterable[str]:
    """Encoders of the task that stands before, or else of all."""
    from jbrep.encoders.shipped import names
    from jbrep.jitterbug.tasks import TASKS

    given = context.params.get("task")
    tasks = [TASKS[given]] if given in TASKS else TASKS.values()
    return sorted({name for task in tasks for name in names(task.describe())})


complete_task, complete_kind, complete_encoder = map(_completing, (_tasks, _kinds, _shipped))
