"""Episodes to look at: where they come from, what policies do in them, and films of them."""
