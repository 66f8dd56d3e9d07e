"""How often words of jbrep's former dialect stand in the tree: python tools/words.py.

Of code, help, messages and pages; the changelog tells of the past, and results of their runs.
"""

import re
import subprocess
from collections import Counter
from pathlib import Path

WORDS = {  # and the field's
    "lanes?": "environment",
    "hand-written": "scripted",
    "constant drive": "constant action",
    "doesn't look": "blind baseline",
    "should serve": "recommended",
    "as it was drawn": "nothing is learned",
    "cohorts?": "-",
    "held over": "-",
    "all learned": "above the baselines",
    "arms?": "condition",
    "judged": "evaluated",
}
ELSEWHERE = "CHANGELOG.md", "results/", "tools/words.py", "tests/"


def main() -> None:
    listed = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True)
    counts = Counter[str]()
    for name in listed.stdout.split():
        if name.endswith((".py", ".md", ".j2", ".toml", "Makefile")) and not name.startswith(
            ELSEWHERE
        ):
            text = Path(name).read_text()
            for word in WORDS:
                counts[word] += len(re.findall(rf"\b{word}\b", text, re.IGNORECASE))
    for word, instead in WORDS.items():
        print(f"{word:16} {counts[word]:5}   {instead}")


if __name__ == "__main__":
    main()
