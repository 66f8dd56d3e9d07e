"""One style for all figures: sized for a paper's column, safe for the colour-blind."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure

from jbrep.encoders import FULL
from jbrep.encoders.names import EncoderName
from jbrep.evaluate.evaluation import Diagnostics, Score
from jbrep.stats.bootstrap import Array, Interval
from jbrep.stats.runs import LARGEST_RETURN

Styles = dict[str, dict[str, Any]]  # colour and marker, by name
Encoders = Mapping[str, Diagnostics]  # of an evaluation, by label
Looks = Callable[[], Styles]  # of a study's representations, in the style in use

COLUMN, PAGE = 3.45, 7.1  # widths in a paper of two columns [inches]
MARKERS = "osD^vPX*"
_ACROSS = 3  # panels side by side

# Okabe and Ito's colours; on dark paper, lighter ones in the same order of hues
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F")
_ON_DARK = ("#56B4E9", "#FF8A3D", "#2BC89B", "#E69FC8", "#F0C940", "#9BD3F5", "#A0A0A0")

PAPER: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelsize": 7,
    "axes.linewidth": 0.6,
    "axes.prop_cycle": cycler(color=_COLOURS),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 7.5,
    "figure.constrained_layout.use": True,
    "font.size": 7,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,  # text stays text
    "savefig.dpi": 250,
    "svg.hashsalt": "jbrep",
    "xtick.labelsize": 6.5,
    "xtick.major.width": 0.6,
    "ytick.labelsize": 6.5,
    "ytick.major.width": 0.6,
}
DARK: Any = {
    **PAPER,
    "savefig.transparent": True,
    "axes.prop_cycle": cycler(color=_ON_DARK),
    **dict.fromkeys(
        ("axes.edgecolor", "axes.labelcolor", "grid.color", "text.color", "xtick.color"), "#DDDDDD"
    ),
    "grid.alpha": 0.16,
    "ytick.color": "#DDDDDD",
}
_SHADES = (0.25, 0.5)  # how far from a colour to that of text, where colours are used again
_LINES = ("-", "--", ":", "-.")  # of codes of a family, from the largest on
_FILLED = 1 / 3  # of an axis of returns, at least, by the returns themselves
_BEYOND = 0.25  # of their range, for the ends of intervals on either side
_DASHES = ("--", "-.", (0, (6, 1.5)), (0, (6, 1.5, 1, 1.5, 1, 1.5)))


def ink() -> str:
    """The colour of text in the style in use."""
    return str(mpl.rcParams["text.color"])


def reference(number: int = 0) -> dict[str, Any]:
    """A line to compare with; several have numbers, and dashes of their own."""
    dashes = _DASHES[number % len(_DASHES)]
    return {"color": ink(), "linestyle": dashes, "linewidth": 0.9, "alpha": 0.65}


def draw_policies(line: Callable[..., Any], returns: Mapping[str, float]) -> None:
    """A line, by axhline or axvline, at what each policy that doesn't learn returns."""
    for i, (policy, each) in enumerate(returns.items()):
        line(each, label=plain(policy), **reference(i))


def draw_solved(line: Callable[..., Any], solved: float, extent: "Limits") -> None:
    """A line, by axhline or axvline, at the return that counts as solved, if it is in sight."""
    if extent.contain(solved):
        line(solved, color=ink(), linestyle=":", linewidth=0.8, alpha=0.65, label="solved")


def styles(names: Iterable[str], first: str | None = None) -> Styles:
    """Colour and marker of each name in the style in use; the first's colour is that of text."""
    colours = mpl.rcParams["axes.prop_cycle"].by_key()["color"]
    others = [name for name in dict.fromkeys(names) if name != first]
    coloured = {
        name: {"color": _colour(colours, i), "marker": MARKERS[(i + 1) % len(MARKERS)]}
        for i, name in enumerate(others)
    }
    return {first: {"color": ink(), "marker": MARKERS[0]}, **coloured} if first else coloured


def _colour(colours: Sequence[str], number: int) -> str:
    """One of the colours, or beyond the last a shade of one, nearer to the colour of text."""
    colour, used = colours[number % len(colours)], number // len(colours)
    if not used:
        return colour
    share = _SHADES[used % len(_SHADES)]
    pairs = zip(to_rgb(colour), to_rgb(ink()), strict=True)
    mixed = [(1 - share) * own + share * text for own, text in pairs]
    return to_hex((mixed[0], mixed[1], mixed[2]))


def family(label: str, latent: int) -> str:
    """An encoder's label without its latent size, if that is in it: dae-s2 of dae-8-s2."""
    name = EncoderName.parse(label)
    return str(name._replace(latent=None)) if name.latent == latent else label


def family_styles(families: Iterable[str]) -> Styles:
    """Colour and marker of each family, denoising autoencoders first; the full one is as text."""
    names = sorted(set(families), key=lambda name: (not name.startswith("dae"), name))
    return styles(names, FULL if FULL in names else None)


def line_styles(encoders: Encoders) -> Styles:
    """Of each encoder: colour and marker of its family, and a line that says its latent size."""
    families = {label: family(label, e.latent) for label, e in encoders.items()}
    sizes: dict[str, list[int]] = {}
    for label, e in encoders.items():
        sizes.setdefault(families[label], []).append(e.latent)
    look, found = family_styles(families.values()), {}
    for label, name in families.items():
        place = sorted(sizes[name], reverse=True).index(encoders[label].latent)
        found[label] = {**look[name], "linestyle": _LINES[place % len(_LINES)]}
    return found


def panel_grid(count: int, height: float, above: float = 0.0) -> tuple[Figure, Sequence[Axes]]:
    """A figure of panels in rows of up to three, a page wide; of one, a column.

    Rows have that height, with room above for a title over all of them [inches].
    """
    across = min(_ACROSS, count)
    rows = -(-count // across)
    figure = Figure(figsize=(COLUMN if across == 1 else PAGE, above + height * rows))
    every = figure.subplots(rows, across, squeeze=False).ravel()
    for axes in every[count:]:
        axes.set_axis_off()
    return figure, list(every[:count])


def plain(text: str) -> str:
    """Text in which a dollar sign begins no formula."""
    return text.replace("$", r"\$")


def with_runs(name: str, counts: Collection[int]) -> str:
    """A representation with the number of its runs, or their range over several groups."""
    numbers = "\N{EN DASH}".join(map(str, dict.fromkeys((min(counts), max(counts)))))
    return plain(f"{name} (n = {numbers})")


def mark_cut(axes: Axes, axis: str, at: float, values: Sequence[float], colour: str) -> None:
    """Mark each edge of a panel beyond which values lie with a triangle that points outwards.

    The values, of which NaN is none, are on an axis, x or y, at a place on the other one. The
    panel has its final limits.
    """
    low, high = axes.get_xlim() if axis == "x" else axes.get_ylim()
    cut = {low: any(value < low for value in values), high: any(value > high for value in values)}
    markers = "<>" if axis == "x" else "v^"
    for (edge, is_cut), marker in zip(cut.items(), markers, strict=True):
        if is_cut:
            place = ([edge], [at]) if axis == "x" else ([at], [edge])
            axes.plot(*place, marker, color=colour, ms=3.5, mew=0, clip_on=False, zorder=5)


class Limits(NamedTuple):
    """What an axis of returns extends over."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Of the axis."""
        return self.high - self.low

    def contain(self, value: float) -> bool:
        """Whether a value lies within; NaN doesn't."""
        return self.low <= value <= self.high

    def with_room(self, share: float) -> tuple[float, float]:
        """The ends with a share of the width more on either side, for whole markers."""
        return self.low - share * self.width, self.high + share * self.width

    def with_ends(self, intervals: Iterable[Interval], floor: float = np.nan) -> "Limits":
        """The limits with the ends of intervals, but not far beyond, nor below the floor.

        NaN is no end, and no floor.
        """
        least, most = self.with_room(_BEYOND)
        values = np.array([[each.value, each.low, each.high] for each in intervals], float)
        ends = np.clip(values[~np.isnan(values)], np.fmax(least, floor), most)
        return Limits(min([self.low, *ends]), max([self.high, *ends]))


def limits(returns: Iterable[float], floor: float = np.nan, solved: float = np.nan) -> Limits:
    """From the least return, or from the floor if it is known, to the largest.

    The return from which on a task counts as solved is within the limits unless it is so far off
    that the returns would fill less than a third of the axis. Returns that aren't finite, or beyond
    any return, don't count; NaN is a floor, or a solved return, that isn't known.
    """
    values = np.array([*returns, floor], float)
    values = values[np.abs(values) <= LARGEST_RETURN]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    wider = Limits(float(np.fmin(low, solved)), float(np.fmax(high, solved)))
    if high - low >= _FILLED * wider.width:
        low, high = wider
    return Limits(low, high) if high > low else Limits(low - 0.5, high + 0.5)


def draw_line(axes: Axes, x: Sequence[Any], scores: Sequence[Score], **style: Any) -> None:
    """A line through values, each with a bar for its interval if it has one."""
    value, low, high = np.array(scores, float).T
    spread = np.nan_to_num((value - low, high - value)).clip(0)
    axes.errorbar(x, value, spread, ms=3, lw=1.1, elinewidth=0.8, capsize=1.5, **style)


def draw_profile(axes: Axes, x: Array, profile: Interval, label: str, colour: str) -> None:
    """The share of runs above each of x (k,), with its interval."""
    share, low, high = profile
    axes.fill_between(x, low, high, step="post", color=colour, alpha=0.12, lw=0)
    axes.step(x, share, where="post", color=colour, label=label)
    axes.set(ylim=(-0.02, 1.02), ylabel="share of runs above")
