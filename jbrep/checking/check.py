"""A check: what to change of a robot before anything learns, worst first."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.checking.advice import Advice, advise, features_toml
from jbrep.checking.features import Shapes, shapes
from jbrep.checking.findings import WORST_FIRST, Finding
from jbrep.checking.relations import Relations
from jbrep.checking.seen import CONSTANT, HELD, REPEATS, Played, Seen, held_for, play, read
from jbrep.coordinates.invariance import NotTheSameError, tried_coordinates
from jbrep.dataset import Dataset
from jbrep.envs.task import Task
from jbrep.errors import InputError
from jbrep.records.record import to_plain
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.text import SIGNIFICANT, Table, counted, duration, facts, interval, wrapped

_NOT_PLAYED = (
    "rewards of simple policies, how long actions must be held, reproducibility, speed, turning "
    "and shifting"
)
_MILLION = 1_000_000


class Check(NamedTuple):
    """What was found of a robot or of data."""

    task: Task
    source: str  # "played", or the folder of the data
    findings: list[Finding]  # worst first
    advice: Advice
    notes: list[str]  # what wasn't asked, and why
    played: Played | None  # None of data
    seen: Seen
    shapes: Shapes

    @property
    def features_file(self) -> str:
        """What a features file says, in TOML."""
        return features_toml(self.task, self.advice.features, self.findings)

    def plain(self) -> dict[str, Any]:
        """All of it but the steps and how fast they were, as plain JSON."""
        found: dict[str, Any] = {
            "task": self.task.name,
            "source": self.source,
            "rows": len(self.seen.before),
            "findings": [each._asdict() | {"title": each.title} for each in self.findings],
            "representation": self.advice.representation,
            "because": self.advice.why,
            "command": self.advice.command.split("\n"),
            "notes": self.notes,
        }
        if self.played:
            found |= {
                "reproducible": self.task.reproducible,
                "steps_per_episode": self.played.limit,
                "returns": {
                    name: {"mean": ends[0], "low": ends[1], "high": ends[2], "episodes": count}
                    for name, (ends, count) in self.returns.items()
                },
                "spread": {str(repeat): each for repeat, each in self.spread.items()},
            }
        return to_plain(found)

    @property
    def returns(self) -> Mapping[str, tuple[list[float | None], int]]:
        """Of each policy the mean return with its 95 % interval, and the number of episodes."""
        bounds = Bounds.of(self.task.return_floor, self.task.return_ceiling)
        return {
            name: (mean_within(each, bounds, LEVEL).tolist(), len(each))
            for name, each in (self.played.returns if self.played else {}).items()
        }

    @property
    def spread(self) -> dict[int, float]:
        """How far random actions drive the state if held, times as far as those of one step."""
        relations = Relations(self.seen, self.shapes, 0)
        deviations = {
            repeat: relations.inputs(self.seen.after[self.seen.policy == held_for(repeat)])[0].std(0)
            for repeat in (1, *REPEATS)
        }
        moved = deviations[1] > 0
        return {
            repeat: float(np.median(each[moved] / deviations[1][moved])) if moved.any() else 1.0
            for repeat, each in deviations.items()
        }

    def text(self, width: int | None = None) -> str:
        """It for a terminal."""
        first = f"{self.task.name}: {counted(self.task.size, 'feature')}, "
        first += f"{counted(len(self.seen.before), 'step')} {self.source}"
        parts = [wrapped(first, width)]
        if not self.findings:
            parts.append("nothing to change was found")
        for number, each in enumerate(self.findings, 1):
            about = f"{', '.join(each.features[:4])}{', ...' * (len(each.features) > 4)}"
            said = {"why": each.evidence, "fix": each.fix}
            title = f"{number}. {each.title}" + (f": {about}" if about else "")
            parts.append(f"{wrapped(title, width)}\n{facts(said, width, indent=3)}")
        if self.played:
            parts.append(self.returns_table().text(width))
            parts.append(facts(self.facts(), width, indent=0))
        parts += [wrapped(each, width) for each in self.notes]
        parts.append(f"begin with {self.advice.representation}: {self.advice.why}")
        parts[-1] += "".join(f"\n    {line}" for line in self.advice.command.split("\n"))
        return "\n\n".join(parts)

    def returns_table(self) -> Table:
        """What policies return that ignore the state; of constant and held actions the best."""
        assert self.played
        whole = self.played.limit == self.task.max_episode_steps
        told, best = dict[str, tuple[str, ...]](), dict[str, float]()
        for name, (ends, count) in self.returns.items():
            family = next((each for each in (CONSTANT, HELD) if name.startswith(each)), "")
            if family and family in told and (ends[0] or 0) <= best[family]:
                continue
            best[family] = ends[0] or 0
            shown = f"{name} (the best of 4)" if family else name
            told[family or name] = (shown, interval(ends, SIGNIFICANT), f"{count:,}")
        cut = "" if whole else f", of {self.played.limit} steps"
        header = (f"policy{cut}", "mean return [95 % interval]", "episodes")
        return Table("", header, [*told.values()])

    def facts(self) -> dict[str, str]:
        """What is worth to know of play."""
        assert self.played
        task, spread = self.task, self.spread
        best = min(r for r, each in spread.items() if each >= 0.9 * max(spread.values()))
        moved = ", ".join(f"{repeat} (x{each:.2g})" for repeat, each in spread.items())
        held = f"how far random actions held for so many steps spread the state: {moved}"
        if best > 1 and spread[best] > 2:
            held += f"; try --set action_repeat={best} or coloured noise"
        cost = duration(_MILLION / self.played.rate)
        return {
            "holding": held,
            "reproducible": "yes" if task.reproducible else "no",
            "speed": f"{self.played.rate:,.0f} steps/s here: 1M steps take {cost} of play",
        }


def check_task(task: Task, steps: int, seed: int, where: Path | None = None) -> Check:
    """Play a task and check what was seen."""
    seen, played = play(task, steps, seed)
    return _check(seen, "played", seed, where, played, None)


def check_data(data: Dataset, steps: int, seed: int, where: Path | None = None) -> Check:
    """Check what is in a data set."""
    seen = read(data, steps, seed)
    return _check(seen, f"of {data.folder}", seed, where, None, data.folder)


def _check(
    seen: Seen, source: str, seed: int, where: Path | None, played: Played | None, data: Path | None
) -> Check:
    known, findings = shapes(seen)
    notes, turned = list[str](), False
    if played:
        world, is_tried = _by_turning(seen.task)
        turned = is_tried
        findings += [world] if world else []
    else:
        notes.append(f"not asked of data: {_NOT_PLAYED}")
    is_symmetric = any(each.kind == "world" for each in findings)
    relations = Relations(seen, known, seed)
    if relations.is_possible:
        findings += relations.findings(turned)
    else:
        notes.append("too few steps to learn what predicts what: more --steps, longer episodes")
    if played and not seen.task.reproducible:
        why = "with the same seed and actions, a fresh and a used instance differ"
        fix = "draw everything from self.np_random, and reset all that an episode changes"
        findings.append(Finding("random", (), why, fix))
    findings.sort(key=lambda each: [*WORST_FIRST].index(each.kind))
    joints = played.joints if played else {}
    advice = advise(seen, known, findings, joints, is_symmetric, where, data)
    return Check(seen.task, source, findings, advice, notes, played, seen, known)


def _by_turning(task: Task) -> tuple[Finding | None, bool]:
    """Whether the world's frame matters where that can be tried, and whether it could."""
    if not any(each.frame == "world" or each.kind == "quaternion" for each in task.features):
        return None, False
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            made = tried_coordinates(task, "symmetry")
    except NotTheSameError:
        return None, True
    except InputError:
        return None, False
    assert made
    if told:  # all rewards were the same
        return None, False
    why = "turned by a quarter and shifted, the robot goes on and is rewarded alike"
    fix = "--encoder symmetry leaves out place and heading"
    return Finding("world", made.not_decoded, why, fix), True
