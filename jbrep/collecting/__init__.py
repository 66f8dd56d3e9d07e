"""Collecting data sets: policies, the collector, and what makes shards again or anew."""

from jbrep.collecting.collector import collect, write_shards

__all__ = ["collect", "write_shards"]
