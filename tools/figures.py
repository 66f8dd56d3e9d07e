"""Redraw the figures and reports in results/ from the tables there: python tools/figures.py."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from jbrep.evaluation.evaluation import Evaluation
from jbrep.records.document import read_document
from jbrep.reporting import write_report
from jbrep.reporting.figures import encoder_plots, write
from jbrep.reporting.findings import Findings
from jbrep.reporting.tables import read_tables

RESULTS = Path("results")


def draw(tables: Path) -> list[Path]:
    if tables.name == "runs.json":
        return write_report(Findings.of(read_tables(tables.parent)), tables.parent)
    return write(encoder_plots(read_document(tables, Evaluation)), tables.parent)


def main() -> None:
    reports = sorted(RESULTS.glob("*/runs.json"))  # these take longest
    with ProcessPoolExecutor() as processes:
        tables = (*reports, *sorted(RESULTS.glob("encoders/*/evaluation.json")))
        for paths in processes.map(draw, tables):
            print(*paths, sep="\n")


if __name__ == "__main__":
    main()
