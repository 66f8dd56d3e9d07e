"""The command line: parse, call one function, print."""

import click

from jbrep.cli.base import Cli
from jbrep.cli.data import collect, data
from jbrep.cli.doctor import doctor
from jbrep.cli.encoders import encoder, evaluate
from jbrep.cli.environment import env
from jbrep.cli.inspect import inspect
from jbrep.cli.policies import behaviour, evaluate_policy, policies
from jbrep.cli.render import render
from jbrep.cli.rl import rl, tune
from jbrep.cli.study import report, study
from jbrep.cli.train import train_dae, train_encoder


@click.group(cls=Cli, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="jbrep")
def main() -> None:
    """Reduced-order representations of robots, and what they do to learning."""


_COMMANDS = (
    *(env, collect, data, train_dae, train_encoder, evaluate, encoder),
    *(rl, tune, policies, evaluate_policy, behaviour, study, report, inspect),
    *(render, doctor),
)
for _command in _COMMANDS:
    main.add_command(_command)
