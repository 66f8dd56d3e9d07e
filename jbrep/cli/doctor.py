"""This machine."""

import click

from jbrep.cli.base import example, printable
from jbrep.text import facts, terminal_width


@click.command(epilog=example("jbrep doctor"))
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
