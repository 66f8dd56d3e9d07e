"""A study on a Ray cluster that loses a node: python tests/helpers/cluster.py OUT."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from jbrep.studies.plan import PROGRESS, Plan
from jbrep.studies.runner import on_ray, run_study

NODE = {"num_cpus": 1, "include_dashboard": False, "include_log_monitor": False}
CONFIG = {
    "health_check_period_ms": 500,  # notices a dead node within seconds
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 2,
    "worker_niceness": 0,  # or workers starve while other tests use the cores
}


@contextmanager
def running_cluster():
    """A cluster whose only node has no core for work."""
    head = {**NODE, "num_cpus": 0, "no_monitor": True, "_system_config": CONFIG}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def loses_a_node(cluster, work, is_at_work):
    """Do work on a node that is killed in the middle of it, and then on another."""
    node = cluster.add_node(**NODE)
    with ThreadPoolExecutor() as pool:  # as Ray starts nodes from the main thread alone
        result = pool.submit(work)
        while not is_at_work():
            assert not result.done()
            time.sleep(0.02)
        cluster.remove_node(node, allow_graceful=False)
        assert not result.done()
        other = cluster.add_node(**NODE)
    cluster.remove_node(other)
    return result.result()


def run(plan):
    """Run a study."""
    with running_cluster() as cluster:
        learn = partial(run_study, plan, on_ray, 2)
        assert loses_a_node(cluster, learn, lambda: any(plan.folder.rglob(PROGRESS))) == 0


if __name__ == "__main__":
    sys.path.append(str(Path(__file__).parent.parent))
    from test_pool import STUDY

    run(Plan(STUDY, Path(sys.argv[1]) / "study"))
