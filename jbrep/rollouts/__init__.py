"""Episodes to look at: where they come from, and what policies do in them."""
