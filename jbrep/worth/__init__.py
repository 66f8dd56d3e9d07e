"""What a code is worth: the return of what is learned from it, cheaply, before agents are trained.

See docs/worth.md.
"""

AGENT = "agent"
WORTH = {  # what can be asked for, and the ways of learning in each, the surest first
    AGENT: (AGENT,),
    "fitted": ("trees", "fourier"),
    "planning": ("linear model", "network model"),
}
