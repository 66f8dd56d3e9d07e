"""The denoising autoencoder: network, training, checkpoints."""
