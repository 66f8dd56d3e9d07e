"""Write the reports in results/ anew, from the tables there: python tools/figures.py."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from jbrep.reporting.findings import Findings
from jbrep.reporting.report import write_report
from jbrep.reporting.tables import read_tables

RESULTS = Path("results")


def draw(tables: Path) -> list[Path]:
    return write_report(Findings.of(read_tables(tables.parent)), tables.parent)


def main() -> None:
    with ProcessPoolExecutor() as processes:
        for paths in processes.map(draw, sorted(RESULTS.glob("*/runs.json"))):
            print(*paths, sep="\n")


if __name__ == "__main__":
    main()
