"""Executors of shards of flights: in this process, or by Ray on the cores and GPUs of one machine or a cluster.

A shard is a batch of flights that is described completely by its item, seeds included. Its result therefore does not
depend on where it is flown, on the number of workers, or on the order in which the shards end.
"""

from __future__ import annotations

import contextlib
import logging
import platform
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

from aero_viz.errors import UserError
from aero_viz.evaluation.machine import versions
from aero_viz.extras import from_extra
from aero_viz.flight.batch import BatchProgress

Item = TypeVar("Item")
Result = TypeVar("Result")
_SHARDS_PER_WORKER = 2
"""Shards per worker, so that a worker has the next one at once."""


class Executor(Protocol):
    """Calls a function for each of many items."""

    threads: int | None
    """Number of CPU threads of the planner in a shard; None is one per core."""

    def map(
        self,
        function: Callable[[Item, BatchProgress | None], Result],
        items: Sequence[Item],
        *,
        progress: BatchProgress | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the index of each item and the function's result for it, in the order in which the calls end.

        Args:
            function: called with an item and with `progress`, or None where progress cannot be followed.
            items: arguments of the calls.
            progress: follows the flights of one shard.
        """
        ...

    def close(self) -> None:
        """Give back the workers."""
        ...


class LocalExecutor:
    """Flies one shard after the other in this process."""

    threads: int | None = None

    def map(
        self,
        function: Callable[[Item, BatchProgress | None], Result],
        items: Sequence[Item],
        *,
        progress: BatchProgress | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the index of each item and the function's result for it, in order."""
        for index, item in enumerate(items):
            yield index, function(item, progress)

    def close(self) -> None:
        """Do nothing: there are no workers."""


class RayExecutor:
    """Flies shards on the workers of Ray: one per GPU if `device` is a GPU, otherwise one per CPU core.

    Ray flies a shard again if its worker or machine is lost.

    Args:
        address: address of a running cluster, such as "10.0.0.1:6379" or "auto"; None starts Ray on this machine.
        device: Warp device of the flights.

    Raises:
        UserError: Ray is not installed, the cluster cannot be reached, it has no GPU although one is needed, or a GPU
            other than the first one is asked for.
    """

    threads: int | None = 1

    def __init__(self, address: str | None = None, *, device: str = "cpu") -> None:
        if device.startswith("cuda") and device not in ("cuda", "cuda:0"):
            raise UserError(f"With --ray each worker sees one GPU, as cuda:0, but --device is {device}; use cuda:0.")
        with from_extra("ray", "Flights on several machines (--ray)"):
            import ray
        self._ray: Any = ray
        self._needs_gpu = device.startswith("cuda")
        options: dict[str, Any] = {"address": address} if address else {"address": "local", "include_dashboard": False}
        handler = signal.getsignal(signal.SIGTERM)
        try:
            # Ray adds the current folder of this moment to the path of imports of its workers.
            with tempfile.TemporaryDirectory() as empty, contextlib.chdir(empty):
                ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)  # Ray's own handler ends the process, and all results are lost
        except Exception as error:  # Ray raises plain exceptions, too
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            where = f"to the Ray cluster at {address}" if address else "to Ray on this machine"
            raise UserError(f"Cannot connect {where}: {reason}") from error
        if self._needs_gpu and not ray.cluster_resources().get("GPU"):
            self.close()
            raise UserError(f"The flights are to run on {device}, but no machine of the Ray cluster has a GPU.")

    @property
    def workers(self) -> int:
        """Number of shards that can be flown at the same time now."""
        return max(1, int(self._ray.cluster_resources().get("GPU" if self._needs_gpu else "CPU", 1)))

    def map(
        self,
        function: Callable[[Item, BatchProgress | None], Result],
        items: Sequence[Item],
        *,
        progress: BatchProgress | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the index of each item and the function's result for it, in the order in which the calls end.

        Raises:
            UserError: a worker raised one, or a machine of the cluster cannot fly, for example because it has other
                versions of the packages.
        """
        resources: dict[str, Any] = {"num_gpus": 1} if self._needs_gpu else {"num_cpus": 1}
        remote = self._ray.remote(max_retries=-1, **resources)(_with_version_check(function, versions()))
        waiting, flying = list(enumerate(items))[::-1], {}
        try:
            while waiting or flying:
                while waiting and len(flying) < _SHARDS_PER_WORKER * self.workers:
                    index, item = waiting.pop()
                    flying[remote.remote(item)] = index
                (done, *_), _ = self._ray.wait(list(flying), num_returns=1)
                try:
                    result = self._ray.get(done)
                except self._ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                yield flying.pop(done), result
        finally:
            for reference in flying:
                self._ray.cancel(reference, force=True)

    def close(self) -> None:
        """Disconnect from the cluster, or stop Ray if it was started here."""
        self._ray.shutdown()


def _with_version_check(function: Callable[[Item, None], Result], required: dict[str, str]) -> Callable[[Item], Result]:
    """Return a function that calls another one after it has compared the versions of the packages on its machine."""

    def run(item: Item) -> Result:
        installed = versions()
        differing = [f"{name} {installed[name]} instead of {required[name]}" for name in required
                     if installed[name] != required[name]]  # fmt: skip
        if differing:
            raise UserError(
                f"A worker on {platform.node()} has other versions: {', '.join(differing)}. "
                "Install the same versions on all machines."
            )
        return function(item, None)

    return run


def open_executor(ray: tuple[str, ...] | None, *, device: str) -> Executor:
    """Return the executor that the flag `--ray` asks for.

    Args:
        ray: None without the flag, () for Ray on this machine, or the address of a cluster.
        device: Warp device of the flights.

    Raises:
        UserError: there is more than one address, or Ray cannot be used.
    """
    if ray is None:
        return LocalExecutor()
    if len(ray) > 1:
        raise UserError(f"--ray takes one address, but was given {len(ray)}: {' '.join(ray)}.")
    return RayExecutor(ray[0] if ray else None, device=device)
