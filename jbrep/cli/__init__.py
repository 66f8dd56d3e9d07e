"""The command line: parse, call one function, print."""

import click

from jbrep.cli.base import Cli
from jbrep.cli.data import collect, data
from jbrep.cli.encoders import encoder, evaluate
from jbrep.cli.environment import env
from jbrep.cli.inspect import inspect
from jbrep.cli.policies import evaluate_policy, policies
from jbrep.cli.policy import policy
from jbrep.cli.render import render
from jbrep.cli.rl import rl, tune
from jbrep.cli.study import report, study
from jbrep.cli.train import train_dae, train_encoder
from jbrep.text import facts, printable, terminal_width


@click.group(
    cls=Cli,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Reduced-order representations of robots, and what they do to learning. Each command's "
    "--help has an example.",
)
@click.version_option(package_name="jbrep")
def main() -> None:
    """The command line."""


@click.command(epilog="Example: jbrep doctor")
@click.pass_context
def doctor(context: click.Context) -> None:
    """Show what this machine has, and what is missing.

    Cores, memory, disk, GPU, OpenGL, and the packages of each extra with their versions. The exit
    code is 1 if a core package is missing or a package has an unsuitable version.
    """
    from jbrep.doctor import examine

    findings = list(examine())
    said = {finding.what: printable(finding.said) for finding in findings}
    click.echo(facts(said, terminal_width(), indent=0))
    context.exit(any(finding.is_wrong for finding in findings))


for _command in (
    *(env, collect, data, train_dae, train_encoder, evaluate, encoder, rl, tune, policies, policy),
    *(evaluate_policy, study, report, inspect, render, doctor),
):
    main.add_command(_command)
