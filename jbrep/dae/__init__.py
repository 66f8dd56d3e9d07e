"""The autoencoder: its network, its gradient, what it learns."""
