"""What a code is worth: the return of what is learned from it, cheaply, before agents are trained.

See docs/worth.md.
"""
