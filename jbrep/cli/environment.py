"""Which environment a command is about, and the command that says what it is."""

import json
from typing import TYPE_CHECKING, Any

import click

from jbrep.cli.base import PATH, POSITIVE, as_json, with_options
from jbrep.cli.completion import complete_task
from jbrep.cli.output import echo_json, echo_text
from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.text import terminal_width

if TYPE_CHECKING:
    from jbrep.envs.task import Task

_ARGUMENTS = ("env", "episode_steps", "features", "missing", "hide", "history")


def _import(context: click.Context, option: click.Parameter, modules: tuple[str, ...]) -> None:
    if modules:
        from jbrep.envs.names import import_modules

        import_modules(modules)


import_option = click.option(
    "--import",
    multiple=True,
    metavar="MODULE",
    expose_value=False,
    is_eager=True,  # it takes effect before the command begins
    callback=_import,
    help="Import a module that registers environments; this runs its code.",
)
view_options = with_options(
    click.option(
        "--hide",
        multiple=True,
        metavar="NAME",
        help="A feature or group that isn't seen, or a pattern: 'velocity_*'; may be repeated.",
    ),
    click.option(
        "--history",
        type=click.IntRange(1, 1000),
        default=1,
        help="States that are seen at once, the current one and those before, with the actions "
        "between.",
    ),
)
environment_options = with_options(
    click.option(
        "--env",
        multiple=True,
        metavar="NAME=VALUE",
        help="An argument of the environment, such as g=1.6; may be repeated.",
    ),
    click.option(
        "--episode-steps",
        type=POSITIVE,
        help="The time limit of an episode; the environment's own by default.",
    ),
    click.option(
        "--features",
        type=PATH,
        help="A TOML file with names, units, ranges, kinds and offsets of the features.",
    ),
    click.option(
        "--missing",
        metavar="[skip|hold:N]",
        help="What becomes of readings that aren't finite: an episode ends before one, or the last "
        "one is held for at most N steps; otherwise they are errors.",
    ),
    view_options,
    import_option,
)
domain_option = click.option(
    "--domain",
    multiple=True,
    metavar="NAME=LOW..HIGH",
    help="What each episode draws: noise, delay, dropped, action_delay, friction, mass, push or "
    "body, such as delay=0..2 or friction=0.5..1.5; may be repeated.",
)
threads_option = click.option(
    "--threads",
    type=click.IntRange(1, 4096),
    help="Threads of a batch, or instances of other environments at once; as many as cores by "
    "default. A robot that exists once needs 1.",
)
retries_option = click.option(
    "--retries",
    type=click.IntRange(0, 1_000_000),
    default=0,
    show_default=True,
    help="How often in a row an environment that fails is made anew and tried again.",
)
# From either, with `environment_options`: `given_task` and `needed_task` make a task.
task_option, needed_task_option = (
    click.option(
        "--task",
        required=required,
        shell_complete=complete_task,
        help="One of the Jitterbug's, such as face_direction, or a Gymnasium id: Hopper-v5.",
    )
    for required in (False, True)
)


def needed_task(options: dict[str, Any]) -> "Task":
    """The task that a command's options name; they are taken out of the options."""
    name = options.pop("task")
    env, *others = (options.pop(option) for option in _ARGUMENTS)
    others.append(parse_arguments(options.pop("domain", ()), "--domain"))
    if name is None:
        raise InputError("give the --task: one of the Jitterbug's, or a Gymnasium id")
    from jbrep.envs.description import describe
    from jbrep.envs.names import name_given

    return describe(name_given(name), parse_arguments(env), *others)


def given_task(options: dict[str, Any]) -> "Task | None":
    """The same where a task may be left out, with all that would be said of it."""
    said = any(options[option] for option in ("task", *_ARGUMENTS[:-1])) or options["history"] > 1
    return needed_task(options) if said else None


def parse_arguments(given: tuple[str, ...], option: str = "--env") -> dict[str, Any]:
    """Arguments from an option's NAME=VALUE; a value is JSON, or else text."""
    arguments: dict[str, Any] = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier() or name in arguments:
            raise InputError(
                f"{option} {pair} isn't an argument, or a second one: write NAME=VALUE"
            )
        try:
            arguments[name] = json.loads(value)
        except (ValueError, RecursionError):
            arguments[name] = value
    return arguments


@click.command(epilog="Example: jbrep env Hopper-v5")
@click.argument("task", shell_complete=complete_task)
@environment_options
@as_json
def env(as_json: bool, **options: Any) -> None:
    """Say what a task is.

    Its features, actions and time limit, and whether it is reproducible. TASK is one of the
    Jitterbug's, such as face_direction, or an id in Gymnasium's registry; for another package's,
    --import MODULE, or MODULE:ID, which imports it. The environment is made and played for some
    steps; that it terminates is only known where it did.
    """
    from jbrep.envs.description import card

    task = needed_task(options)
    if as_json:
        echo_json(to_plain(task))
        return
    echo_text(card(task, terminal_width()))
