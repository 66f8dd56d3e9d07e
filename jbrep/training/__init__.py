"""Training networks by gradient: windows of steps, batches, epochs, checkpoints."""
