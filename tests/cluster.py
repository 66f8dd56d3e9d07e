"""A study or a data set on a Ray cluster of two nodes, one of which dies.

python tests/cluster.py study OUT, or python tests/cluster.py data OUT.
"""

import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

NOTICE = {  # a dead node within seconds
    "health_check_period_ms": 500,
    "health_check_timeout_ms": 500,
    "health_check_failure_threshold": 2,
}


@contextmanager
def dying_cluster(is_at_work):
    """Two nodes of a core each; one is killed once they are at work."""
    node = {"num_cpus": 1, "include_dashboard": False, "include_log_monitor": False}
    head = {**node, "no_monitor": True, "_system_config": NOTICE}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    other = cluster.add_node(**node)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")

    over = threading.Event()

    def kill():
        while not is_at_work():
            if over.wait(0.02):
                return
        cluster.remove_node(other, allow_graceful=False)
        print("a node died at work", flush=True)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield
    finally:
        over.set()
        killer.join()
    ray.shutdown()
    cluster.shutdown()


def run_a_study(out):
    from test_study import ON_RAY

    from jbrep.study.plan import Plan
    from jbrep.study.runner import on_ray
    from jbrep.study.study import run_study
    from jbrep.study.work import PROGRESS

    with dying_cluster(lambda: len(list(out.rglob(PROGRESS))) >= 2):  # a run on each node
        return run_study(Plan(ON_RAY, out), on_ray, 2)


def collect_data(out):
    from test_any_collect import LONG

    from jbrep.collect import collect

    with dying_cluster(lambda: (out / "shard-00001.h5").exists()):
        assert collect(LONG, out, backend="ray").manifest.complete


if __name__ == "__main__":
    sys.exit({"study": run_a_study, "data": collect_data}[sys.argv[1]](Path(sys.argv[2])))
