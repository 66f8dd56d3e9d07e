"""What a code is worth: the return of what is learned from it, cheaply, before agents are trained.

See docs/worth.md.
"""

from collections.abc import Iterable

from jbrep.errors import choose

AGENT = "agent"
WORTH = {  # what can be asked for, and the ways of learning in each, the surest first
    AGENT: (AGENT,),
    "fitted": ("trees", "fourier"),
    "planning": ("linear model", "network model"),
}


def check_ways(asked: Iterable[str]) -> None:
    """Check that all that is asked for are keys of WORTH.

    Raises:
        InputError: one isn't.
    """
    for each in asked:
        choose(each, WORTH, "way to find a code's worth")
