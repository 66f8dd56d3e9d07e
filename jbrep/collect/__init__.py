"""Collecting data sets: policies, the collector, and what makes shards again or anew."""

from jbrep.collect.collector import Written, collect, write_shards

__all__ = ["Written", "collect", "write_shards"]
