"""`python -m jbrep` is `jbrep`."""

from jbrep.cli import main

main(prog_name="jbrep")
