"""A benchmark on a real Ray cluster of two nodes on this machine."""

import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from aero_viz.errors import UserError
from aero_viz.evaluation.bench import Run
from aero_viz.evaluation.executor import RayExecutor, open_executor

TIMING = ("plan_ms_median", "build_s", "run_s")


def without_timing(run: Run) -> list[dict[str, Any]]:
    kept = [{key: value for key, value in flight.items() if key not in TIMING} for flight in run.flights]
    return sorted(kept, key=lambda flight: (flight["row"], flight["index"]))


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head and a second node, with one core each."""
    from ray.cluster_utils import Cluster

    cluster = Cluster()
    for _ in range(2):
        _add_node(cluster)
    yield cluster
    cluster.shutdown()


def _add_node(cluster: Any, attempts: int = 3) -> None:
    """Start a node. Ray gives up after 30 s, which is not enough on a busy machine."""
    try:
        cluster.add_node(num_cpus=1, include_dashboard=False)
    except Exception as error:
        if attempts == 1 or "timed out" not in str(error):
            raise
        _add_node(cluster, attempts - 1)


def test_a_cluster_that_loses_a_node_returns_the_same_flights(fly: Callable[..., Run], cluster: Any):
    alone = fly("alone", flights=4, batch=1)
    (node,) = cluster.worker_nodes
    handler = signal.getsignal(signal.SIGTERM)
    executor = RayExecutor(cluster.address)
    assert signal.getsignal(signal.SIGTERM) == handler  # of the command line, which keeps what has been flown

    def lose_the_node(finished: int, total: int, text: str) -> None:
        if finished == 2 and node in cluster.worker_nodes:
            cluster.remove_node(node, allow_graceful=False)

    try:
        assert executor.workers == 2
        spread = fly("spread", flights=4, batch=1, executor=executor, progress=lose_the_node)
        assert node not in cluster.worker_nodes and spread.is_complete
        assert without_timing(spread) == without_timing(alone)
    finally:
        executor.close()


def test_ray_addresses_are_checked():
    with pytest.raises(UserError, match="takes one address, but was given 2"):
        open_executor(("a", "b"), device="cpu")
    with pytest.raises(UserError, match="each worker sees one GPU, as cuda:0"):
        open_executor((), device="cuda:1")
    assert open_executor(None, device="cpu").threads is None
