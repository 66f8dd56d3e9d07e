"""Looking at episodes, encoders and studies in the Rerun viewer."""

import os
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import click

from jbrep.cli.base import COUNT, example, printable, stoppable
from jbrep.errors import InputError

_ADDRESS = "127.0.0.1"


@click.command(epilog=example("jbrep inspect data/face --episode 3 --encoder dae-8 --view"))
@click.argument("source", required=False)
@click.option("--episode", type=COUNT, help="Which one, from 0; 0 if not given.")
@click.option("--task", help="Of a policy, or of an encoder without a SOURCE.")
@click.option("--encoder", help="A file, or a name that ships; a run's own if not given.")
@click.option("--traverse", is_flag=True, help="Show what each unit of the latent moves.")
@click.option(
    "--out", type=click.Path(path_type=Path), help="An .rrd file; one in inspect/ if not given."
)
@click.option("--view", is_flag=True, help="Open it in the Rerun viewer.")
@click.option("--serve", is_flag=True, help="Show it to a browser on this machine until Ctrl-C.")
def inspect(
    source: str | None,
    episode: int | None,
    task: str | None,
    encoder: str | None,
    traverse: bool,
    out: Path | None,
    view: bool,
    serve: bool,
) -> None:
    """Record an episode, encoder or study to see in Rerun.

    SOURCE is a data set, a run, a folder with several runs, an encoder's file, or a policy such as
    heuristic. With an encoder the robot that comes back stands beside the true one.
    """
    if view and serve:
        raise InputError("--view and --serve exclude each other: choose one")
    from jbrep.inspection import inspect as record

    path = record(source, episode, task, encoder, traverse, out)
    click.echo(printable(f"{path}" if view or serve else f"{path}; open it with: rerun {path}"))
    if view:
        _run_viewer(path)
    if serve:
        page, data = _free_ports(2)
        click.echo(f"http://{_ADDRESS}:{page}/?url=rerun%2Bhttp://{_ADDRESS}:{data}/proxy")
        click.echo("Ctrl-C stops it")
        ports = ("--web-viewer-port", str(page), "--port", str(data))
        _run_viewer(path, "--serve-web", *ports)


def _free_ports(count: int) -> list[int]:
    """Ports that nobody listens on: on one in use Rerun would talk to whoever does."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server((_ADDRESS, 0))) for _ in range(count)]
        return [each.getsockname()[1] for each in sockets]


def _run_viewer(path: Path, *options: str) -> None:
    """Run Rerun's own program until it ends, or this one is told to."""
    command = [sys.executable, "-m", "rerun", "--bind", _ADDRESS, *options, str(path)]
    # a group of its own, as the program is a child of the script that starts it
    with stoppable(f"{path} stays"), subprocess.Popen(command, process_group=0) as viewer:
        try:
            code = viewer.wait()
        finally:
            with suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGTERM)
    if code:
        raise InputError(f"the Rerun viewer ended with code {code}; {path} stays")
