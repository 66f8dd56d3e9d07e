"""A check: what to change of a robot before anything learns, worst first."""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jbrep.checking.advice import Advice, advise, features_toml
from jbrep.checking.features import WORST_FIRST, Finding, Shapes, shapes
from jbrep.checking.relations import Relations
from jbrep.checking.transitions import REPEATS, PlayStats, Transitions, play, read
from jbrep.coordinates.invariance import NotTheSameError, tried_coordinates
from jbrep.dataset import Dataset
from jbrep.envs.task import Task
from jbrep.errors import InputError, Notice
from jbrep.records.record import to_plain
from jbrep.stats.intervals import LEVEL, Bounds, mean_within
from jbrep.text import Table, counted, duration, facts, interval, terminal_width, wrapped

_NOT_PLAYED = (
    "not asked of data: what simple policies return, how long actions must be held, whether it is "
    "reproducible, how fast it steps, and what turning and shifting the robot changes"
)
_RETURNS = "mean", "low", "high", "episodes"
_FAR = 2.0  # times as far, from which on holding actions is worth a try


class Check(NamedTuple):
    """What was found of a robot or of data."""

    data: Path | None  # the folder of the data that was checked; None if the task was played
    findings: list[Finding]  # worst first
    advice: Advice
    notes: list[str]  # what wasn't asked, and why
    seen: Transitions
    shapes: Shapes
    played: PlayStats | None  # None of data

    def __repr__(self) -> str:
        return self.text(terminal_width())

    @property
    def features_file(self) -> str:
        """What a features file says, in TOML."""
        return features_toml(self.seen.task, self.advice.features, self.findings)

    def plain(self) -> dict[str, Any]:
        """All of it but the steps and how fast they were, as plain JSON."""
        return {
            "task": self.seen.task.name,
            "data": None if self.data is None else str(self.data),
            "steps": len(self.seen.before),
            "findings": to_plain([{**e._asdict(), "title": e.title} for e in self.findings]),
            "representation": self.advice.representation,
            "because": self.advice.why,
            "command": self.advice.command.split("\n"),
            "notes": self.notes,
            "reproducible": self.seen.task.reproducible,
            "returns": {n: dict(zip(_RETURNS, e, strict=True)) for n, e in self.returns.items()},
            "spread": {str(repeat): far for repeat, far in self.spread.items()},
        }

    @property
    def source(self) -> str:
        """Where the steps are from, as words that follow their number."""
        return "played" if self.data is None else f"of {self.data}"

    @property
    def returns(self) -> dict[str, tuple[float | None, ...]]:
        """Of each policy the mean return, the ends of its 95 % interval, and the episodes."""
        bounds = Bounds.of(self.seen.task.return_floor, self.seen.task.return_ceiling)
        every = self.played.returns.items() if self.played else ()
        return {n: (*mean_within(e, bounds, LEVEL).tolist(), len(e)) for n, e in every}

    @property
    def spread(self) -> dict[int, float]:
        """How far random actions drive the median feature if held, as a multiple of one step's."""
        if not self.played:
            return {}
        inputs, far = Relations(self.seen, self.shapes, 0).inputs, dict[int, Any]()
        for name, repeat in REPEATS.items():
            far[repeat] = inputs(self.seen.after[self.seen.policy == name])[0].std(axis=0)
        if not (moves := far[1] > 0).any():
            return {}
        return {n: float(np.median(each[moves] / far[1][moves])) for n, each in far.items()}

    def text(self, width: int | None = None) -> str:
        """It for a terminal."""
        task, advice = self.seen.task, self.advice
        size = f"{counted(task.size, 'feature')}, {counted(len(self.seen.before), 'step')}"
        parts = [wrapped(f"{task.name}: {size} {self.source}", width)]
        for number, each in enumerate(self.findings, 1):
            said = facts({"why": each.evidence, "fix": each.fix}, width, indent=3)
            parts.append(f"{wrapped(f'{number}. {each.title}', width)}\n{said}")
        parts += [] if self.findings else ["nothing to change was found"]
        parts += (
            [f"{self.table.text(width)}\n\n{facts(self.facts, width, 0)}"] if self.played else []
        )
        parts += [wrapped(each, width) for each in self.notes]
        command = advice.command.replace("\n", "\n    ")
        begin = wrapped(f"begin with {advice.representation}: {advice.why}", width)
        parts.append(f"{begin}\n    {command}")
        return "\n\n".join(parts)

    @property
    def table(self) -> Table:
        """What policies return that ignore the state."""
        limit, whole = (self.played.limit if self.played else 0), self.seen.task.max_episode_steps
        cut = f" in {limit} steps" if limit < whole else ""
        rows = [
            (name, interval(ends), f"{count:,}") for name, (*ends, count) in self.returns.items()
        ]
        return Table("", (f"return{cut} of", "mean [95 % interval]", "episodes"), rows)

    @property
    def facts(self) -> dict[str, str]:
        """What else playing tells."""
        spread, rate = self.spread, self.played.rate if self.played else 1.0
        held = ", ".join(f"{repeat} (x{each:.2g})" for repeat, each in spread.items())
        far = [repeat for repeat, each in spread.items() if each >= 0.9 * max(spread.values())]
        advice = f"; try --set action_repeat={far[0]}" if far and spread[far[0]] > _FAR else ""
        return {
            "holding": f"growth of features' spread by steps that actions are held: {held}{advice}"
            if spread
            else "random actions of one step each move nothing",
            "reproducible": "yes" if self.seen.task.reproducible else "no",
            "speed": f"{rate:,.0f} steps/s here: 1M steps take {duration(1e6 / rate)} of play",
        }


def check_task(task: Task, steps: int, seed: int, where: Path | None = None) -> Check:
    """Play a task and check what was seen; `where` its features file is written, if it is."""
    seen, played = play(task, steps, seed)
    return _check(seen, seed, where, played, None)


def check_data(data: Dataset, steps: int, seed: int, where: Path | None = None) -> Check:
    """Check what is in a data set."""
    return _check(read(data, steps, seed), seed, where, None, data.folder)


def _check(
    seen: Transitions, seed: int, where: Path | None, played: PlayStats | None, data: Path | None
) -> Check:
    known, findings = shapes(seen)
    notes, is_turned, is_symmetric = [] if played else [_NOT_PLAYED], False, False
    if played:
        world, is_turned = _by_turning(seen.task)
        is_symmetric = bool(world)
        findings += world
    relations = Relations(seen, known, seed)
    if relations.is_possible:
        findings += relations.findings(is_turned)
    else:
        notes.append("too few steps, or features that move, to see what predicts what")
    if played and not seen.task.reproducible:
        why = "with the same seed and actions, a fresh and a used instance differ"
        fix = "draw everything from self.np_random, and reset all that an episode changes"
        findings.append(Finding("random", (), why, fix))
    findings.sort(key=lambda each: [*WORST_FIRST].index(each.kind))
    advice = advise(seen, known, findings, is_symmetric, where, data)
    return Check(data, findings, advice, notes, seen, known, played)


def _by_turning(task: Task) -> tuple[list[Finding], bool]:
    """Whether the world's frame doesn't matter, and whether that could be tried."""
    if not any(each.frame == "world" or each.kind == "quaternion" for each in task.features):
        return [], False
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = tried_coordinates(task, "symmetry")
    except InputError as error:
        return [], isinstance(error, NotTheSameError)
    is_noted = any(issubclass(each.category, Notice) for each in caught)
    if is_noted or not made:  # all rewards were the same, which tells nothing
        return [], False
    why = "turned by a quarter and shifted, the robot goes on and is rewarded alike"
    fix = "--encoder symmetry leaves out place and heading"
    return [Finding("world", made.not_decoded, why, fix)], True
