"""Single episodes: where they come from, and what policies do in them."""
