"""What registered studies could have shown, as in results/power.txt: python tools/power.py."""

from pathlib import Path

from jbrep.report.statistics import prospects_table
from jbrep.report.words import EFFECTS
from jbrep.stats.power import prospects
from jbrep.study import Plan
from jbrep.study.registration import REGISTRATION, read_registration

RESULTS = Path("results")


def main() -> None:
    print(EFFECTS)
    for path in sorted(RESULTS.glob(f"*/{REGISTRATION}")):
        registration = read_registration(path.parent)
        if registration is None or not registration.registered.verdicts.primary:
            continue
        plan = Plan(registration.registered, path.parent)
        arms = {cell.label: plan.study.arms(cell.representation) for cell in plan.cells}
        found = [*prospects(plan.study.planned, arms)]
        print(f"\n{path.parent}\n\n{prospects_table(found).text()}")


if __name__ == "__main__":
    main()
