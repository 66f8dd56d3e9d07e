"""Draw the figures and reports in results/ anew, from the tables there: python tools/figures.py."""

import json
from pathlib import Path

from jbrep.figures import encoder_plots, write
from jbrep.report import write_report

RESULTS = Path("results")


def main() -> None:
    for evaluation in sorted(RESULTS.glob("encoders/*/evaluation.json")):
        plots = encoder_plots(json.loads(evaluation.read_text()))
        for path in write(plots, evaluation.parent):
            print(path)
    for tables in sorted(RESULTS.glob("*/runs.json")):
        for path in write_report(tables.parent):
            print(path)


if __name__ == "__main__":
    main()
