"""A study's data and encoders, before its agents: python tools/prepare.py STUDY FOLDER."""

import sys
from pathlib import Path

from jbrep.records.storage import exclusive
from jbrep.studies import Plan, read_study
from jbrep.studies.prepare import check, prepare
from jbrep.studies.runner import usual_workers


def main(file: Path, folder: Path) -> None:
    plan = Plan(read_study(file), folder, file)
    check(plan)
    plan.write()
    with exclusive(plan.folder):
        prepare(plan, usual_workers(plan))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
