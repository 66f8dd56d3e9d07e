"""What an environment is."""

from typing import Any

import click

from jbrep.cli.base import as_json, echo_json, echo_text, example
from jbrep.cli.environment import needed_task, task_options
from jbrep.records.record import to_plain
from jbrep.text import terminal_width


@click.command(epilog=example("jbrep env Hopper-v5"))
@click.argument("task")
@task_options(named=False)
@as_json
def env(as_json: bool, **options: Any) -> None:
    """Say what a task is.

    Its features, actions and time limit, and whether it is reproducible. TASK is one of the
    Jitterbug's, such as face_direction, or an id in Gymnasium's registry; for another package's,
    --import MODULE, or MODULE:ID, which imports it. The environment is made and played for some
    steps; that it terminates is only known where it did.
    """
    from jbrep.envs.card import card

    task = needed_task(options)
    if as_json:
        echo_json(to_plain(task))
        return
    echo_text(card(task, terminal_width()))
