"""What predicts what, judged on held-out episodes: what is missing, and what isn't needed."""

from functools import cached_property
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from jbrep.checking.features import Finding, Shapes, several
from jbrep.checking.transitions import Transitions
from jbrep.coordinates.formulas import FORMULAS
from jbrep.dataset.scaled import sample
from jbrep.envs.task import Array
from jbrep.evaluation.evaluation import Score
from jbrep.evaluation.held_out import explained
from jbrep.evaluation.regression import Predictor, Problem, beside, fit
from jbrep.stats.bootstrap import by_episode
from jbrep.text import counted

PAST = 3  # steps before the current one that a history has
_FEWEST_ROWS, _MOST_ROWS = 100, 30_000  # to fit, and to judge on
_HELD_OUT = 0.3  # of the episodes, or of blocks of a few long ones
_FEWEST_EPISODES, _BLOCKS = 8, 20
_GAIN, _SURE_GAIN = 0.1, 0.03  # of R^2 by a history: the least, and between the intervals
_LEFT = 0.6  # of the error: what a history leaves, at most
_OF_ACTIONS = 0.7  # of that gain by past actions alone, where they explain it
_HARDLY, _MOSTLY, _KNOWN, _SPARE = 0.1, 0.5, 0.8, 0.02  # R^2: bounds of such words; a margin
_LOSS = 0.01  # of R^2, that what is left out may cost
_DEPENDS = 0.003, 2.0  # error by a shuffled feature: share of variation, times the error before
_SLOW, _ENDS = 0.2, 0.2  # change of a place by its deviation; share of ends at extreme values
_SPARSE, _SMALL = 0.05, 0.01  # share of steps whose reward differs by this share of its range


class Relations:
    """Regressions on what was seen, of features without jumps, each known once."""

    def __init__(self, seen: Transitions, shapes: Shapes, seed: int):
        self._seen, self._shapes, self._random = seen, shapes, np.random.default_rng(seed)
        features = seen.task.features
        firsts = (place.start for place in seen.task.groups.values())
        declared = (i for i in firsts if features[i].kind == "quaternion")
        self._quaternions = {*shapes.quaternions, *declared}
        rows = np.flatnonzero(seen.step >= PAST)
        groups = seen.episode[rows]
        if len(np.unique(groups)) < _FEWEST_EPISODES:
            groups = np.arange(len(rows)) * _BLOCKS // max(1, len(rows))
        every = self._random.permutation(np.unique(groups))
        held_out = np.isin(groups, every[: max(1, int(_HELD_OUT * len(every)))])
        self._train, self._test = (sample(rows[part], _MOST_ROWS) for part in (~held_out, held_out))
        chosen = groups[np.searchsorted(rows, self._test)]
        self._group = np.unique(chosen, return_inverse=True)[1]
        is_enough = min(len(self._train), len(self._test)) >= _FEWEST_ROWS
        self.is_possible = is_enough and len(shapes.idle) < len(features) and bool(self._targets[1])

    def findings(self, is_turned: bool) -> list[Finding]:
        """What rewards, and what is observed at once, lack; places, unless turning told of them."""
        of_reward = self._of_reward()
        world = None if is_turned or of_reward else self._unneeded()
        return [each for each in (of_reward, self._of_history(), world) if each]

    # numbers without jumps

    def inputs(self, rows: Array) -> tuple[Array, NDArray[np.int64]]:
        """Observations (n, d) as numbers (n, p) without jumps, and the feature that each is of."""
        made, owners, inside = list[Array](), list[int](), list[int]()
        rows = self._with_changes(rows)
        for i, feature in enumerate(self._seen.task.features):
            part, turn = [rows[:, i]], self._shapes.turns.get(i)
            if i in self._quaternions:
                part = FORMULAS["attitude"].forward(np, [*rows[:, i : i + 4].T], 0.0)
                inside += [i + 1, i + 2, i + 3]
            elif turn or feature.is_angle:
                angle = rows[:, i] * (2 * np.pi / turn.size if turn else 1)
                part = [np.cos(angle), np.sin(angle)]
            if i not in (*self._shapes.idle, *inside):
                made += part
                owners += [i] * len(part)
        return np.column_stack([rows[:, :0], *made]), np.array(owners)

    def _with_changes(self, rows: Array) -> Array:
        """Changes in place of earlier states, as regressions shrink small effects."""
        if not (view := self._seen.task.view):
            return rows
        whole = {start + part for start in self._quaternions for part in range(4)}
        size = len(view.places)
        before = np.array([i for i in range(size, size * view.history) if i not in whole], int)
        changed = rows.copy()
        changed[:, before] = rows[:, before - size] - rows[:, before]
        return changed

    @cached_property
    def _targets(self) -> tuple[Array, list[int]]:
        """What features change by in each step, those that do, and the feature of each column.

        Rewards come last, for -1, where they are known and vary: by their ranks, since a few large
        ones would hide what all others depend on.
        """
        seen = self._seen
        change = seen.after - seen.before
        for i, turn in self._shapes.turns.items():
            change[:, i] -= turn.size * np.round(change[:, i] / turn.size)
        for i in self._quaternions:
            now, then = seen.before[:, i : i + 4], seen.after[:, i : i + 4]
            along = (now * then).sum(axis=1, keepdims=True)
            change[:, i : i + 4] = np.where(along < 0, -then, then) - now
        kept = np.setdiff1d(np.flatnonzero(change.std(axis=0)), self._shapes.idle).tolist()
        if np.isfinite(seen.reward).all() and np.ptp(seen.reward):
            ranks = rankdata(seen.reward) / len(seen.reward)
            return np.column_stack((change[:, kept], ranks)), [*kept, -1]
        return change[:, kept], kept

    @cached_property
    def _given(self) -> dict[str, Array]:
        """What is predicted from, (n, p) each: now, with more or less of the past."""
        action, state = self._seen.action, self.inputs(self._seen.before)[0]
        actions, states = ([np.roll(x, k, 0) for k in range(1, PAST + 1)] for x in (action, state))
        now = np.hstack((state, action))
        acted = np.hstack((now, *actions))
        return {"now": now, "acted": acted, "all": np.hstack((acted, *states)), "action": action}

    # regressions

    def _fit(self, *problems: tuple[Array, Array]) -> list[Predictor]:
        """Ridge regressions plus networks fitted to their residuals; the last column its own."""
        from sklearn.linear_model import Ridge  # not at the top: it takes seconds
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        rows = [(given[self._train], wanted[self._train]) for given, wanted in problems]
        models = [make_pipeline(StandardScaler(), Ridge()).fit(x, y) for x, y in rows]
        ridges = [lambda x, m=each: m.predict(x).reshape(len(x), -1) for each in models]
        residuals = [y - ridge(x) for (x, y), ridge in zip(rows, ridges, strict=True)]
        parts = [np.hsplit(each, [-1]) if each.shape[1] > 1 else [each] for each in residuals]
        inputs = [x for (x, _), ys in zip(rows, parts, strict=True) for _ in ys]
        networks = iter(fit([*map(Problem, inputs, chain(*parts))]))
        corrections = [beside(*islice(networks, len(ys))) for ys in parts]
        return [
            lambda x, ridge=ridge, network=network: ridge(x) + network(x)  # type: ignore[misc]
            for ridge, network in zip(ridges, corrections, strict=True)
        ]

    @cached_property
    def _predictors(self) -> dict[str, Predictor]:
        """Of all that changes, from what there is now, with all the past, from actions alone."""
        names = "now", "all", "action"
        made = self._fit(*((self._given[name], self._targets[0]) for name in names))
        return dict(zip(names, made, strict=True))

    def _predicted(self, name: str) -> Array:
        """Predictions for the held-out rows."""
        return self._predictors[name](self._given[name][self._test])

    def _scores(self, predicted: Array, wanted: Array) -> list[Score]:
        """R^2 of each column, with an interval over episodes."""

        def sums(rows: NDArray[np.int64], *values: NDArray[np.float64]) -> list[Array]:
            return [by_episode(each, self._group, int(self._group[-1]) + 1) for each in values]

        return explained(predicted, wanted[self._test], self._test, sums, [1] * wanted.shape[1])

    def _r2(self, predicted: Array, wanted: Array) -> Array:
        """The same alone, 0 where it is less, (k,)."""
        return np.array([max(each.value or 0, 0) for each in self._scores(predicted, wanted)])

    def _of_reward(self) -> Finding | None:
        reward, (wanted, places) = self._seen.reward, self._targets
        usual = float(np.median(reward))
        if places[-1:] != [-1]:  # how long an episode lasts may say something, if a state ends it
            if np.isnan(usual) or self._seen.ended.any():
                return None
            why = f"it is {usual:.4g} at every step, and no state ends an episode"
            return Finding("reward", (), why, "give a reward that depends on the state")
        share = float((np.abs(reward - usual) > _SMALL * np.ptp(reward)).mean())
        if share < _SPARSE:
            why = f"it differs from {usual:.4g} in {share:.2%} of the steps"
            fix = "shape it, as by the distance that is left, or explore by a policy that gets some"
            return Finding("sparse", (), why, fix, {"share": share})
        whole, alone = (self._r2(self._predicted(name), wanted)[-1] for name in ("now", "action"))
        numbers = {"r2": whole, "r2_of_action": alone}
        if whole < _HARDLY or (alone > _KNOWN and whole - alone < _SPARE):
            why = f"observation and action predict its rank with an R² of {whole:.2f}, "
            why += f"the action alone with {alone:.2f}"
            fix = "reward what the robot should do, and show what that depends on"
            return Finding("reward", (), why, fix, numbers)
        return None

    def _of_history(self) -> Finding | None:
        wanted, places = self._targets
        predictions = [self._predicted("now"), self._predicted("all")]
        now, past = (self._r2(each, wanted) for each in predictions)
        ends = zip(*(self._scores(each, wanted) for each in predictions), strict=True)
        apart = np.array([(after.low or 0) - max(before.high or 0, 0) for before, after in ends])
        is_hit = (past - now > _GAIN) & (apart > _SURE_GAIN) & (1 - past < _LEFT * (1 - now))
        hits = np.flatnonzero(is_hit).tolist()
        if not hits:
            return None
        given = self._given["acted"]
        (of_acted,) = self._fit((given, wanted))
        acted = self._r2(of_acted(given[self._test]), wanted)
        names = tuple(self._seen.task.feature_names[places[i]] for i in hits if places[i] >= 0)
        best = hits[int((past - now)[hits].argmax())]
        about = "the reward" if places[best] < 0 else self._seen.task.feature_names[places[best]]
        numbers = {"r2": now[best], "r2_of_history": past[best]}
        why = (
            f"the change of {about} is predicted with an R² of {now[best]:.2f}, with the {PAST} "
            f"steps before {past[best]:.2f}"
        )
        if (acted - now)[hits].mean() >= _OF_ACTIONS * (past - now)[hits].mean():
            first = self._given["now"].shape[1] - self._seen.action.shape[1]
            lags = np.arange(first, given.shape[1]).reshape(PAST + 1, -1)
            errors = [self._shuffled("acted", of_acted, columns)[hits].sum() for columns in lags]
            lag = int(np.argmax(errors))
            numbers |= {"lag": lag, "history": max(lag, 1) + 1}
            why += f"; the action {counted(lag, 'step')} before matters most"
            fix = f"--history {numbers['history']}, which shows the last actions, too"
            return Finding("delay", names, why, fix, numbers)
        numbers["history"] = PAST + 1
        fix = f"--history {PAST + 1}, or fewer; or show what is missing, such as velocities"
        return Finding("hidden", names, why, fix, numbers)

    def _shuffled(self, name: str, of: Predictor, columns: NDArray[np.int64]) -> Array:
        """Mean squared error by what changes' variance, some columns shuffled, (k,)."""
        wanted, given = self._targets[0][self._test], self._given[name][self._test]
        given[:, columns] = self._random.permutation(given[:, columns])
        error: Array = ((of(given) - wanted) ** 2).mean(axis=0) / wanted.var(axis=0)
        return error

    # places in the world

    def _unneeded(self) -> Finding | None:
        """Places and headings that neither the reward nor the change of other features needs."""
        wanted, places = self._targets
        present = self._r2(self._predicted("now"), wanted)
        if places[-1:] != [-1] or present[-1] < _KNOWN:
            return None
        owners = self.inputs(self._seen.before[:1])[1]
        least = np.maximum(_DEPENDS[0], _DEPENDS[1] * (1 - present))
        needs = dict[int, set[int]]()  # by feature, the targets that depend on it
        for at, i in enumerate(places[:-1]):
            if present[at] > _MOSTLY and i in owners and self._is_place(at, i):
                columns = np.flatnonzero(owners == i)
                more = self._shuffled("now", self._predictors["now"], columns) - (1 - present)
                needs[i] = {places[k] for k in np.flatnonzero(more > least)}
        left = [*needs]
        while wrong := [i for i in left if needs[i] - {*left}]:
            left = [i for i in left if i not in wrong]
        if not left or len(left) == len(places) - 1:
            return None
        state, _ = self.inputs(self._seen.before)
        kept = [k for k, i in enumerate(places) if i not in left]
        rest, left_out = state[:, ~np.isin(owners, left)], state[:, np.isin(owners, left)]
        less, needed = np.hstack((rest, self._seen.action)), wanted[:, kept]
        of_less, of_left = self._fit((less, needed), (rest, left_out))
        losses = present[kept] - self._r2(of_less(less[self._test]), needed)
        loss = float(max(losses[-1], np.median(losses)))  # the reward's, or the median of all
        # what the others tell is no place, but the same in other numbers
        again = self._r2(of_left(rest[self._test]), left_out).max()
        if loss > _LOSS or again > _MOSTLY:
            return None
        names = tuple(self._seen.task.feature_names[i] for i in left)
        why = (
            f"without {several(names)} the reward and the change of all else are predicted as "
            f"well, to {max(loss, 0):.3f} of R²"
        )
        return Finding("world", names, why, several(names, "--hide ", " "), {"loss": loss})

    def _is_place(self, at: int, i: int) -> bool:
        """Whether a feature moves a little in each step, and episodes don't end at its extremes."""
        seen, change = self._seen, self._targets[0][:, at]
        low, high = np.quantile(seen.before[:, i], (0.02, 0.98))
        last = seen.after[seen.ended, i]
        is_end = len(last) and ((last < low) | (last > high)).mean() > _ENDS
        is_slow = i in self._shapes.turns or change.std() < _SLOW * seen.before[:, i].std()
        return bool(is_slow and not is_end) and i not in self._quaternions
