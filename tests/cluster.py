"""A study on a Ray cluster of two nodes, one of which dies: python tests/cluster.py OUT."""

import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import ray
from ray.cluster_utils import Cluster
from test_study import TINY

from jbrep.study.plan import Plan
from jbrep.study.runner import on_ray
from jbrep.study.study import run_study
from jbrep.study.work import PROGRESS

NOTICE = {  # a dead node within seconds
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 2,
}


def main(out):
    node = {"num_cpus": 1, "include_dashboard": False, "include_log_monitor": False}
    head = {**node, "no_monitor": True, "_system_config": NOTICE}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    other = cluster.add_node(**node)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")

    def kill():
        while len(list(out.rglob(PROGRESS))) < 2:  # both nodes are at work
            time.sleep(0.02)
        cluster.remove_node(other, allow_graceful=False)
        print("a node died at work", flush=True)

    killer = threading.Thread(target=kill)
    killer.start()
    crashed = run_study(Plan(replace(TINY, seeds=(0,)), out), on_ray, 2)  # a run for each node
    killer.join()
    ray.shutdown()
    cluster.shutdown()
    return crashed


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
