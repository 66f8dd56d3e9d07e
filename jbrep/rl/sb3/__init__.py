"""stable-baselines3 as the trainer of one run at a time, for all of its algorithms."""
