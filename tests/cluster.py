"""A study and a data set on a Ray cluster that loses a node: python tests/cluster.py OUT."""

import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from jbrep.collect import collect
from jbrep.study.plan import Plan
from jbrep.study.runner import on_ray
from jbrep.study.study import run_study
from jbrep.study.work import PROGRESS

NODE = {"num_cpus": 1, "include_dashboard": False, "include_log_monitor": False}
CONFIG = {
    "health_check_period_ms": 500,  # notices a dead node within seconds
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 2,
    "worker_niceness": 0,  # or workers starve while other tests use the cores
}


@contextmanager
def running_cluster():
    """A cluster of a node with one core."""
    head = {**NODE, "no_monitor": True, "_system_config": CONFIG}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    yield cluster
    ray.shutdown()
    cluster.shutdown()


@contextmanager
def dying_node(cluster, is_at_work):
    """A second node, which is killed once both are at work."""
    node, over = cluster.add_node(**NODE), threading.Event()

    def kill():
        while not is_at_work():
            if over.wait(0.02):
                return
        cluster.remove_node(node, allow_graceful=False)
        print("a node died at work", flush=True)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield
    finally:
        over.set()
        killer.join()


def run(study, study_folder, data, data_folder):
    """Run the study first: its runs overlap where neither node has a worker yet."""
    with running_cluster() as cluster:
        with dying_node(cluster, lambda: len(list(study_folder.rglob(PROGRESS))) >= 2):
            assert run_study(Plan(study, study_folder), on_ray, 2) == 0
        with dying_node(cluster, (data_folder / "shard-00001.h5").exists):
            assert collect(data, data_folder, backend="ray").manifest.complete


if __name__ == "__main__":
    from test_cluster import DATA, STUDY

    folder = Path(sys.argv[1])
    run(STUDY, folder / "study", DATA, folder / "data")
