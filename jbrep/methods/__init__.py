"""Ways of making an encoder from a data set."""
