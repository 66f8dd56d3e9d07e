"""What tells what, by regressions judged on held-out episodes: what lacks, and what isn't needed."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jbrep.checking.features import Shapes
from jbrep.checking.findings import Finding, several
from jbrep.checking.seen import Seen
from jbrep.coordinates.formulas import FORMULAS
from jbrep.dataset.scaled import sample
from jbrep.envs.task import Array
from jbrep.evaluation.regression import Predictor, Problem, fit, ridge
from jbrep.stats.bootstrap import bootstrap, by_episode, r_squared, variation
from jbrep.text import counted

PAST = 3  # steps before the current one that a history has
_MOST_ROWS = 30_000  # to fit, and to judge on
FEWEST_ROWS = 300
_HELD_OUT = 0.3  # of the episodes, or of blocks of a few long ones
_FEWEST_EPISODES, _BLOCKS = 8, 20
_GAIN, _SURE_GAIN = 0.1, 0.03  # of R^2 by a history: the least, and the least end of its interval
_LEFT = 0.6  # of the error: what a history leaves, at most
_OF_ACTIONS = 0.7  # of that gain by past actions alone, where they explain it
_KNOWN = 0.8  # R^2 of the reward, from which on it tells what it needs
_DEPENDS = 0.003, 0.5  # error by a shuffled feature: share of variation, or of the error before
_LOSS = 0.01  # of R^2, that what is left out may cost
_SLOW = 0.2  # of a feature's deviation, by which a place changes in a step
_ENDS = 0.2  # share of episodes' ends at extreme values, from which on a feature decides them
_HARDLY, _MOSTLY, _SPARE = 0.1, 0.5, 0.02  # R^2 of rewards
_SPARSE, _SMALL = 0.05, 0.01  # share of steps whose reward differs by this share of its range


class Relations:
    """Regressions on what was seen, each feature without jumps and known ones left out.

    Args:
        seen: the steps.
        shapes: what is known of the features.
        seed: of the episodes that are held out.
    """

    def __init__(self, seen: Seen, shapes: Shapes, seed: int):
        self.seen, self._shapes = seen, shapes
        rows = np.flatnonzero(seen.step >= PAST)
        groups = seen.episode[rows]
        if len(np.unique(groups)) < _FEWEST_EPISODES:
            groups = np.arange(len(rows)) * _BLOCKS // max(1, len(rows))
        random = np.random.default_rng(seed)
        every = random.permutation(np.unique(groups))
        held_out = np.isin(groups, every[: max(1, int(_HELD_OUT * len(every)))])
        self.train = sample(rows[~held_out], _MOST_ROWS)
        self.test = sample(rows[held_out], _MOST_ROWS)
        chosen = groups[np.searchsorted(rows, self.test)]
        self._group = np.unique(chosen, return_inverse=True)[1]
        self.has_reward = bool(np.isfinite(seen.reward).all())
        self._random = random

    @property
    def is_possible(self) -> bool:
        """Whether there are rows enough."""
        return min(len(self.train), len(self.test)) >= FEWEST_ROWS * _HELD_OUT / 2

    # numbers without jumps

    def inputs(self, rows: Array, without: Sequence[int] = ()) -> tuple[Array, list[int]]:
        """Observations (n, d) as numbers to predict from, and the feature that each is of."""
        made, owners = list[Array](), list[int]()
        i = 0
        while i < rows.shape[1]:
            part, width = [rows[:, i]], 1
            if i in self._quaternions:
                part, width = FORMULAS["attitude"].forward(np, [*rows[:, i : i + 4].T], 0.0), 4
            elif turn := self._shapes.turns.get(i):
                angle = (rows[:, i] - turn.low) * (2 * np.pi / turn.size)
                part = [np.cos(angle), np.sin(angle)]
            elif self.seen.task.features[i].is_angle:
                part = [np.cos(part[0]), np.sin(part[0])]
            if i not in self._shapes.idle and i not in without:
                made += part
                owners += [i] * len(part)
            i += width
        return np.column_stack(made) if made else np.zeros((len(rows), 0)), owners

    @cached_property
    def _quaternions(self) -> set[int]:
        declared = [
            place.start
            for place in self.seen.task.groups.values()
            if self.seen.task.features[place.start].kind == "quaternion"
        ]
        return {*self._shapes.quaternions, *declared}

    @cached_property
    def targets(self) -> tuple[Array, list[int]]:
        """What features change by in each step, those that do, and the feature of each column.

        Rewards come last, for -1, where they are known and vary.
        """
        seen, kept = self.seen, list[int]()
        change = seen.after - seen.before
        for i, turn in self._shapes.turns.items():
            change[:, i] -= turn.size * np.round(change[:, i] / turn.size)
        for i in self._quaternions:
            place = slice(i, i + 4)
            along = (seen.before[:, place] * seen.after[:, place]).sum(axis=1, keepdims=True)
            change[:, place] = np.where(along < 0, -1, 1) * seen.after[:, place]
            change[:, place] -= seen.before[:, place]
        kept = [i for i in np.flatnonzero(change.std(axis=0)) if i not in self._shapes.idle]
        columns = [change[:, kept]]
        if self.has_reward and seen.reward.std():
            columns.append(seen.reward[:, None])
            kept.append(-1)
        return np.hstack(columns), kept

    # regressions

    def _fit(self, inputs: Sequence[Array], wanted: Sequence[Array]) -> list[Predictor]:
        """Ridge regressions, and networks of what these leave, of the rows to fit."""
        lines = [ridge(x[self.train], y[self.train]) for x, y in zip(inputs, wanted, strict=True)]
        left = [
            Problem(x[self.train], y[self.train] - line(x[self.train]))
            for x, y, line in zip(inputs, wanted, lines, strict=True)
        ]

        def both(line: Predictor, network: Predictor) -> Predictor:
            return lambda values: line(values) + network(values)

        return [both(line, rest) for line, rest in zip(lines, fit(left), strict=True)]

    def _errors(self, predicted: Array, wanted: Array) -> Array:
        """Sums of squares by held-out episode, (episodes, k)."""
        return self._sums((predicted - wanted[self.test]) ** 2)

    def _sums(self, values: Array) -> Array:
        return by_episode(values, self._group, int(self._group[-1]) + 1)

    def _about(self, wanted: Array) -> tuple[Array, Array, Array]:
        true = wanted[self.test] - wanted[self.test].mean(axis=0)
        ones = np.ones((len(self.test), 1))
        return self._sums(true), self._sums(true**2), self._sums(ones)

    def _r2(self, predicted: Array, wanted: Array) -> Array:
        """Of each column, (k,)."""
        residual = self._errors(predicted, wanted).sum(axis=0)
        total, squares, count = (each.sum(axis=0) for each in self._about(wanted))
        return np.nan_to_num(r_squared(residual, variation(total, squares, count)))

    def _past(self, values: Array) -> list[Array]:
        """Values (n, k) of the steps before each, the latest first; wrong in the first ones."""
        return [np.roll(values, lag, axis=0) for lag in range(1, PAST + 1)]

    def findings(self, is_turned: bool) -> list[Finding]:
        """What rewards, and what is observed at once, lack; and places that aren't needed.

        Args:
            is_turned: whether turning and shifting the robot says already which are.
        """
        of_reward = self._of_reward()
        world = None if is_turned or of_reward else self._unneeded()
        return [each for each in (of_reward, self._of_history(), world) if each]

    # rewards

    def _of_reward(self) -> Finding | None:
        reward = self.seen.reward
        if not self.has_reward:
            return None
        usual, ends = float(np.median(reward)), self.seen.ended.any()
        if not np.ptp(reward):
            if ends:  # then how long an episode lasts says something
                return None
            why = f"it is {usual:.4g} at every step, and no state ends an episode"
            return Finding("reward", (), why, "give a reward that depends on the state")
        varied = float((np.abs(reward - usual) > _SMALL * np.ptp(reward)).mean())
        if varied < _SPARSE:
            why = f"{varied:.2%} of the steps have another than {usual:.4g}, the usual one"
            fix = "shape it, as by the distance that is left; or explore by a policy that gets some"
            return None if ends else Finding("sparse", (), why, fix, {"share": varied})
        now, after = self._inputs, self.inputs(self.seen.after)[0]
        action, wanted = self.seen.action, reward[:, None]
        given = [np.hstack((now, action, after)), action]
        whole, alone = (
            float(self._r2(predict(x[self.test]), wanted)[0])
            for x, predict in zip(given, self._fit(given, [wanted] * 2), strict=True)
        )
        numbers = {"r2": whole, "r2_of_action": alone}
        if whole < _HARDLY:
            why = (
                "what is observed before and after a step, with the action, predicts it with an "
                f"R² of {max(whole, 0):.2f}"
            )
            return Finding("reward", (), why, "show what it depends on, or reward that", numbers)
        if alone > _MOSTLY and whole - alone < _SPARE:
            why = f"the action alone predicts it with an R² of {alone:.2f}; all else adds nothing"
            return Finding("reward", (), why, "reward what the robot should do", numbers)
        return None

    @cached_property
    def _inputs(self) -> Array:
        return self.inputs(self.seen.before)[0]

    # histories

    @cached_property
    def _now(self) -> Array:
        return np.hstack((self._inputs, self.seen.action))

    @cached_property
    def _predictors(self) -> list[Predictor]:
        """Of what becomes of it: from now, with actions before, with a step before, with all."""
        return self._fit(self._seen_at_once, [self.targets[0]] * 4)

    @cached_property
    def _seen_at_once(self) -> list[Array]:
        actions, states = self._past(self.seen.action), self._past(self._inputs)
        acted = np.hstack((self._now, *actions))
        short = np.hstack((self._now, actions[0], states[0]))
        return [self._now, acted, short, np.hstack((acted, *states))]

    def _of_history(self) -> Finding | None:
        wanted, places = self.targets
        given = [each[self.test] for each in self._seen_at_once]
        told = [of(values) for of, values in zip(self._predictors, given, strict=True)]
        errors = [self._errors(each, wanted) for each in told]

        def gains(*sums: Array) -> Array:
            about = variation(*sums[4:])
            now, *others = (np.nan_to_num(r_squared(each, about)) for each in sums[:4])
            return np.stack([each - np.maximum(now, 0) for each in others], axis=-2)

        gained = bootstrap(gains, *errors, *self._about(wanted))
        (by_actions, _, by_all), sure = gained.value, gained.low[2]
        before, *_, after = (each.sum(axis=0) for each in errors)
        hits = np.flatnonzero((by_all > _GAIN) & (sure > _SURE_GAIN) & (after < _LEFT * before))
        if not len(hits):
            return None
        names = tuple(self._name(places[hit]) for hit in hits)
        best = hits[by_all[hits].argmax()]
        now, _, short, past = (float(self._r2(each, wanted)[best]) for each in told)
        numbers = {"r2": now, "r2_of_history": past}
        why = (
            f"the change of {names[hits.tolist().index(best)]} is predicted with an R² of "
            f"{max(now, 0):.2f}, with the {PAST} steps before it {past:.2f}"
        )
        if by_actions[hits].mean() >= _OF_ACTIONS * by_all[hits].mean():
            lag = self._lag(hits)
            if lag:
                why += f"; the action {counted(lag, 'step')} ago matters most"
            numbers |= {"lag": lag, "history": max(lag, 1) + 1}
            fix = f"--history {numbers['history']}, which shows the last actions, too"
            return Finding("delay", names, why, fix, numbers)
        numbers["history"] = 2 if short > past - _SPARE else PAST + 1
        fix = f"--history {numbers['history']}; or show what is missing, such as velocities"
        return Finding("hidden", names, why, fix, numbers)

    def _name(self, place: int) -> str:
        return "the reward" if place < 0 else self.seen.task.feature_names[place]

    def _lag(self, hits: NDArray[np.int64]) -> int:
        """How many steps ago the action was that matters most, by shuffling each."""
        wanted, acted = self.targets[0], self._seen_at_once[1][self.test]
        count, worst = self.seen.action.shape[1], list[float]()
        first = acted.shape[1] - (PAST + 1) * count
        for lag in range(PAST + 1):
            shuffled = acted.copy()
            place = slice(first + lag * count, first + (lag + 1) * count)
            shuffled[:, place] = self._random.permutation(shuffled[:, place])
            error = self._errors(self._predictors[1](shuffled), wanted).sum(axis=0)
            worst.append(float((error / wanted[self.test].var(axis=0))[hits].sum()))
        return int(np.argmax(worst))

    # places in the world

    def _unneeded(self) -> Finding | None:
        """Places and headings that neither the reward nor the change of other features needs."""
        wanted, places = self.targets
        present = self._r2(self._predictors[0](self._now[self.test]), wanted)
        if not places or places[-1] != -1 or present[-1] < _KNOWN:
            return None
        left = self._ignorable(present)
        if not left or len(left) == len(places) - 1:
            return None
        inputs, _ = self.inputs(self.seen.before, left)
        kept = [at for at, place in enumerate(places) if place not in left]
        given = np.hstack((inputs, self.seen.action))
        (of_less,) = self._fit([given], [wanted[:, kept]])
        loss = present[kept] - self._r2(of_less(given[self.test]), wanted[:, kept])
        if loss.max() > _LOSS:
            return None
        names = tuple(self.seen.task.feature_names[i] for i in left)
        why = (
            f"without {several(names)} the reward and the change of all else are predicted as "
            f"well, to {max(float(loss.max()), 0):.3f} of R²"
        )
        fix = " ".join(f"--hide {name}" for name in names)
        return Finding("world", names, why, fix, {"loss": float(loss.max())})

    def _ignorable(self, present: Array) -> list[int]:
        """Features that change slowly, and that nothing else that is needed depends on."""
        now, of_now, (wanted, places) = self._now, self._predictors[0], self.targets
        owners = self.inputs(self.seen.before[:1])[1]
        error = self._errors(of_now(now[self.test]), wanted).sum(axis=0)
        about = wanted[self.test].var(axis=0) * len(self.test)
        needs = dict[int, set[int]]()  # by feature, the targets that depend on it
        for i in self._slow(present):
            shuffled = now[self.test]
            columns = [at for at, owner in enumerate(owners) if owner == i]
            shuffled[:, columns] = self._random.permutation(shuffled[:, columns])
            more = self._errors(of_now(shuffled), wanted).sum(axis=0) - error
            least = np.maximum(_DEPENDS[0] * about, _DEPENDS[1] * np.minimum(error, about))
            needs[i] = {places[at] for at in np.flatnonzero(more > least)}
        left = [*needs]
        while wrong := [i for i in left if needs[i] - {*left}]:
            left = [i for i in left if i not in wrong]
        return left

    def _slow(self, present: Array) -> Iterator[int]:
        """Features that others move, a little in each step, and at which episodes don't end."""
        seen, (wanted, places) = self.seen, self.targets
        for at, i in enumerate(places):
            if i < 0 or present[at] < _MOSTLY or i in self._quaternions:
                continue
            values = self.seen.before[:, i]
            if i not in self._shapes.turns and wanted[:, at].std() > _SLOW * values.std():
                continue
            low, high = np.quantile(values, (0.02, 0.98))
            last = seen.after[seen.ended, i]
            if len(last) and ((last < low) | (last > high)).mean() > _ENDS:
                continue
            yield i
