"""Statistics over runs: does a smaller state help? The run is the unit of replication."""
