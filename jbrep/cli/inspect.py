"""Looking at episodes and encoders in the Rerun viewer."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from shlex import quote
from typing import Any

import click

from jbrep.cli.base import COUNT, PATH
from jbrep.cli.completion import complete_encoder
from jbrep.cli.environment import environment_options, given_task, task_option
from jbrep.cli.output import say
from jbrep.cli.signals import stoppable
from jbrep.errors import InputError

_ADDRESS = "127.0.0.1"
# Waits for the end of its input, which comes when jbrep ends, even killed; then ends its own group.
_KEEPER = ("sh", "-c", "read -r _; kill 0")


@click.command(epilog="Example: jbrep inspect data/face --episode 3 --encoder dae-8 --view")
@click.argument("source", required=False)
@click.option("--episode", type=COUNT, help="Its number, from 0; 0 if not given.")
@task_option
@click.option(
    "--encoder",
    shell_complete=complete_encoder,
    help="A file, a name that ships, or code, mymodule:MyEncoder; a run's own if not given.",
)
@click.option("--traverse", is_flag=True, help="Show what each unit of the latent moves.")
@click.option("--out", type=PATH, help="An .rrd file; one in inspect/ if not given.")
@click.option("--view", is_flag=True, help="Open it in the Rerun viewer.")
@click.option(
    "--serve",
    is_flag=True,
    help="Show it to a browser on this machine until Ctrl-C. Meanwhile every user and program of "
    "the machine can read the recording, too; Rerun asks for no password and checks no host name.",
)
@environment_options
def inspect(
    source: str | None,
    episode: int | None,
    encoder: str | None,
    traverse: bool,
    out: Path | None,
    view: bool,
    serve: bool,
    **options: Any,
) -> None:
    """Record an episode or encoder to see in Rerun.

    SOURCE is a data set, a run, an encoder's file, or a policy such as uniform, which needs a
    --task, as does an encoder by its name. An unfinished run plays its last checkpoint. The robot
    is shown where MuJoCo simulates it; with an encoder, what is decoded is shown beside what was
    observed, and for the Jitterbug the decoded robot beside the true one.
    """
    if view and serve:
        raise InputError("--view and --serve exclude each other: choose one")
    from jbrep.encoders.shipped import check_found
    from jbrep.envs.names import import_code
    from jbrep.play.sources import check_source
    from jbrep.records.storage import exists

    task = given_task(options)
    import_code(encoder)
    if task and encoder is not None:
        check_found(encoder, task)
    if source and not exists(source):
        check_source(source)
    from jbrep.inspection import inspect as record  # imports torch

    path = record(source, episode, task, encoder, traverse, out, say)
    if view or serve:
        say(str(path))
    else:
        click.echo("open it with:")
        say(f"rerun {quote(str(path))}")
    if view:
        _run_viewer(path)
    if serve:
        page, recording = _free_ports()
        click.echo(f"http://{_ADDRESS}:{page}/?url=rerun%2Bhttp://{_ADDRESS}:{recording}/proxy")
        click.echo("Ctrl-C stops it")
        ports = ("--web-viewer-port", str(page), "--port", str(recording))
        _run_viewer(path, "--serve-web", *ports)


def _free_ports() -> tuple[int, int]:
    """Unused ports: on one in use, Rerun would connect to the program that listens there."""
    anything = (_ADDRESS, 0)
    with socket.create_server(anything) as one, socket.create_server(anything) as other:
        return one.getsockname()[1], other.getsockname()[1]


def _run_viewer(path: Path, *options: str) -> None:
    """Run Rerun's viewer until it ends, or this process does in whatever way."""
    command = [sys.executable, "-m", "rerun", "--bind", _ADDRESS, *options, str(path)]
    quiet = {"RUST_LOG": "warn", **os.environ}
    with (
        stoppable(f"{path} stays"),
        subprocess.Popen(_KEEPER, stdin=subprocess.PIPE, process_group=0) as keeper,
        # in the keeper's group, as is the program that this script starts
        subprocess.Popen(command, process_group=keeper.pid, env=quiet) as viewer,
    ):
        try:
            code = viewer.wait()
        finally:
            assert keeper.stdin is not None
            keeper.stdin.close()
    if code:
        raise InputError(f"the Rerun viewer ended with code {code}; {path} stays")
