"""A grid of runs from a TOML file: prepared, run side by side, judged."""
