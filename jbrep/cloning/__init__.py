"""Policies that are learned from a data set alone, without an environment."""
