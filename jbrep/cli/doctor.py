"""This machine."""

import textwrap

import click

from jbrep.cli.base import example, printable

_INDENT, _WIDTH = 9, 100


@click.command(epilog=example("jbrep doctor"))
@click.pass_context
def doctor(context: click.Context) -> None:
    """Show what this machine has, and what is missing.

    Cores, memory, disk, GPU, OpenGL, and the packages of each extra with their versions. The exit
    code is 1 if a core package is missing or a package has an unsuitable version.
    """
    from jbrep.doctor import examine

    findings = list(examine())
    for finding in findings:
        line = f"{finding.what:{_INDENT}}{printable(finding.said)}"
        indent = " " * _INDENT
        click.echo(textwrap.fill(line, _WIDTH, subsequent_indent=indent, break_on_hyphens=False))
    context.exit(any(finding.is_wrong for finding in findings))
