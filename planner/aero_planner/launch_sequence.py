"""Recorded kernel launches and their replay.

On the CPU a launch runs on one thread but releases the interpreter, so a pool of worker threads processes the chunks of
a stage. On CUDA all launches replay as one graph, with side streams for independent stages.
"""

from __future__ import annotations

import itertools
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import warp as wp

Launch = tuple[str, Callable[[], Any]]
"""A launch, and the name of the stage under which its time is counted."""
Chunk = list[Launch]
"""Launches that run one after another."""
PLAN = "plan"
"""Name of the stages that plan."""
RESET = "reset"
"""Name of the stages that run before the next plan if one was interrupted."""


def usable_cores() -> int:
    """Return the number of cores that this process may use: all of the machine, or those of its CPU affinity."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class _Branches:
    """Streams on which launches run in parallel on CUDA; on a CPU, and while disabled, nothing happens.

    Args:
        device: device of the launches.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._is_enabled = device.is_cuda
        self._side_streams: dict[str, wp.Stream] = {}
        self._ends: dict[str, wp.Event] = {}
        self._main_stream: Any = None

    def begin(self) -> None:
        """Use the present stream of the device as the main stream."""
        self._main_stream = self._device.stream if self._is_enabled else None

    def fork(self, name: str, after: str | None = None) -> None:
        """Put the following launches on a side stream, after everything so far or after a branch that has ended."""
        if self._is_enabled:
            if name not in self._side_streams:
                self._side_streams[name] = wp.Stream(self._device)
            begin = self._main_stream.record_event() if after is None else self._ends[after]
            self._side_streams[name].wait_event(begin)
            self._device.set_stream(self._side_streams[name], sync=False)

    def end_fork(self, name: str) -> None:
        """Put the following launches on the main stream, in parallel with those of the branch."""
        if self._is_enabled:
            self._ends[name] = self._side_streams[name].record_event()
            self._device.set_stream(self._main_stream, sync=False)

    def join(self, name: str) -> None:
        """Let the main stream wait for the launches between `fork` and `end_fork`."""
        if self._is_enabled:
            self._main_stream.wait_event(self._ends[name])

    @contextmanager
    def disabled(self) -> Iterator[None]:
        """On CUDA, run everything on one stream."""
        is_enabled, self._is_enabled = self._is_enabled, False
        try:
            yield
        finally:
            self._is_enabled = is_enabled


class LaunchSequence:
    """Stages of launches on one device, which run one after another.

    Nothing in the stages refers to the sequence. In a reference cycle, the device memory of all arrays would wait for
    Python's garbage collector, which does not know of it.

    Args:
        device: device of the launches.
        workers: CPU threads that share the chunks of a stage; 1 on CUDA.
        dry: True to note the kernels only, in `kernels`, without a device that could run them.

    Attributes:
        kernels: kernel and block size of each launch that was recorded.
        stages: stages in order, by the name of what they do; the chunks of a stage may run at the same time.
        stage_ms: time of each stage in the last `run` on the CPU [ms].
    """

    def __init__(self, device: wp.Device, workers: int, *, dry: bool = False) -> None:
        self.kernels: list[tuple[wp.Kernel, int]] = []
        self.stages: dict[str, list[list[Chunk]]] = {}
        self.stage_ms: dict[str, float] = {}
        self._device, self._workers, self._dry = device, workers, dry
        self._is_interrupted = False
        self._executor = ThreadPoolExecutor(workers - 1, "aero-planner") if workers > 1 else None
        self._branches = _Branches(device)
        self._graphs: dict[str, Any] = {}

    def record(
        self, kernel: Any, dim: tuple[int, ...], *, inputs: list[Any], outputs: list[Any], block_dim: int = 256
    ) -> Callable[[], Any]:
        """Record a launch and return the function that runs it."""
        self.kernels.append((kernel, block_dim))
        if self._dry:
            return lambda: None
        command: Any = wp.launch(
            kernel, dim, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True, block_dim=block_dim
        )
        return command.launch

    @staticmethod
    def serial(name: str, *launches: Callable[[], Any]) -> list[Chunk]:
        """Return a stage of one chunk."""
        return [[(name, launch) for launch in launches]]

    def branch(self, name: str, *launches: Callable[[], Any], after: str | None = None) -> list[Callable[[], Any]]:
        """Return launches that on CUDA run on a side stream, in parallel with those between them and the join.

        They begin after everything so far or, with `after`, after the branch of that name.
        """
        return [self.fork(name, after), *launches, self.end_fork(name)]

    def fork(self, name: str, after: str | None = None) -> Callable[[], Any]:
        """Return a launch that on CUDA puts the following ones on a side stream.

        They run after everything so far or, with `after`, after the branch of that name, which must have ended.
        """
        return partial(self._branches.fork, name, after)

    def end_fork(self, name: str) -> Callable[[], Any]:
        """Return a launch that on CUDA puts the following ones on the main stream, in parallel with the branch."""
        return partial(self._branches.end_fork, name)

    def join(self, name: str) -> Callable[[], Any]:
        """Return a launch that on CUDA lets the main stream wait for the launches between `fork` and `end_fork`."""
        return partial(self._branches.join, name)

    def run(self, name: str = PLAN) -> None:
        """Run all stages of `name` in order. On the CPU, `stage_ms` then holds the time of each stage [ms]."""
        if self._is_interrupted:  # an error or Ctrl-C has left counters that a plan resets at its end
            self._run_eagerly(RESET)
        self._is_interrupted = True
        if self._device.is_cpu:
            self._run_eagerly(name)
        elif name not in self._graphs:
            self._run_eagerly(name)  # loads the modules, which a capture cannot do
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                self._run_eagerly(name)
            self._graphs[name] = capture.graph
        else:
            wp.capture_launch(self._graphs[name])
        self._is_interrupted = False

    def time_stages(self, repeat: int) -> dict[str, list[float]]:
        """Return the time of each stage in `repeat` plans [ms].

        On CUDA the stages run one after another here, with an event after each; in `run` some of them run at the same
        time.
        """
        device = self._device
        if device.is_cpu:
            runs = []
            for _ in range(repeat):
                self.run()
                runs.append(self.stage_ms)
            names = dict.fromkeys(name for stage_ms in runs for name in stage_ms)
            return {name: [stage_ms.get(name, 0.0) for stage_ms in runs] for name in names}
        events: list[tuple[str, wp.Event]] = []

        def record_event(name: str) -> None:
            event = wp.Event(device, enable_timing=True)
            device.stream.record_event(event, external=True)
            events.append((name, event))

        with self._branches.disabled(), wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            record_event("")
            launches = [launch for stage in self.stages[PLAN] for chunk in stage for launch in chunk]
            for i, (name, launch) in enumerate(launches):
                launch()
                if i + 1 == len(launches) or launches[i + 1][0] != name:
                    record_event(name)
        graph: Any = capture.graph
        times: dict[str, list[float]] = {name: [0.0] * repeat for name, _ in events[1:]}
        for i in range(repeat):
            wp.capture_launch(graph)
            wp.synchronize_device(device)
            for (_, begin), (name, end) in itertools.pairwise(events):
                times[name][i] += wp.get_event_elapsed_time(begin, end)
        return times

    def capture_graph(self) -> Any:
        """Return the launches as a graph for `wp.capture_save`, in sequence; they must have run once before.

        On the CPU there must be one worker.
        """
        with self._branches.disabled(), wp.ScopedCapture(device=self._device, apic=True) as capture:
            self._run_eagerly(PLAN)
        return capture.graph

    def _run_eagerly(self, name: str) -> None:
        self._branches.begin()
        self.stage_ms = {}
        for stage in self.stages[name]:
            chunks = deque(stage)
            helpers = min(len(chunks), self._workers) - 1
            futures: list[Future[None]] = []
            try:
                if self._executor:
                    for _ in range(helpers):
                        futures.append(self._executor.submit(self._run_chunks, chunks, {}))
                self._run_chunks(chunks, self.stage_ms)
            finally:
                # After an error or Ctrl-C, too, no launch may run on: its arrays may be freed next.
                chunks.clear()
                started = time.perf_counter()
                for future in futures:
                    with suppress(CancelledError):  # by `close`
                        future.exception()
            for future in futures:
                future.result()
            if futures:
                last = stage[0][-1][0]
                self.stage_ms[last] = self.stage_ms.get(last, 0.0) + 1e3 * (time.perf_counter() - started)

    @staticmethod
    def _run_chunks(chunks: deque[Chunk], stage_ms: dict[str, float]) -> None:
        """Run chunks until none is left; several threads call this at once."""
        while chunks:
            try:
                chunk = chunks.popleft()
            except IndexError:  # another thread took the last one
                return
            for name, launch in chunk:
                started = time.perf_counter()
                launch()
                stage_ms[name] = stage_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - started)

    def close(self) -> None:
        """Stop the worker threads, without waiting for one that hangs."""
        if self._executor:
            self._executor.shutdown(wait=False, cancel_futures=True)
