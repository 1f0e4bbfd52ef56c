"""Recorded kernel launches and their replay.

On the CPU a launch runs on one thread but releases the interpreter, so a pool of worker threads processes the chunks of
a stage. On CUDA all launches replay as one graph, with a side stream for independent stages.
"""

from __future__ import annotations

import itertools
import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import warp as wp

Launch = tuple[str, Callable[[], Any]]
"""A launch, and the name of the stage under which its time is counted."""
Chunk = list[Launch]
"""Launches that run one after another."""


def usable_cores() -> int:
    """Return the number of cores that this process may use: all of the machine, or those of its CPU affinity."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class LaunchSequence:
    """Stages of launches on one device, which run one after another.

    Args:
        device: device of the launches.
        workers: CPU threads that share the chunks of a stage; 1 on CUDA.

    Attributes:
        stages: stages in order; the chunks of a stage may run at the same time.
        stage_ms: time of each stage in the last `run` on the CPU [ms].
    """

    def __init__(self, device: wp.Device, workers: int) -> None:
        self.stages: list[list[Chunk]] = []
        self.stage_ms: dict[str, float] = {}
        self._device, self._workers = device, workers
        self._executor = ThreadPoolExecutor(workers - 1, "aero-planner") if workers > 1 else None
        self._side_stream: Any = wp.Stream(device) if device.is_cuda else None
        self._graph: Any = None

    def record(
        self, kernel: Any, dim: tuple[int, ...], *, inputs: list[Any], outputs: list[Any], block_dim: int = 256
    ) -> Callable[[], Any]:
        """Record a launch and return the function that runs it."""
        command: Any = wp.launch(
            kernel, dim, inputs=inputs, outputs=outputs, device=self._device, record_cmd=True, block_dim=block_dim
        )
        return command.launch

    @staticmethod
    def serial(name: str, *launches: Callable[[], Any]) -> list[Chunk]:
        """Return a stage of one chunk."""
        return [[(name, launch) for launch in launches]]

    def side_branch(self, name: str, *launches: Callable[[], Any]) -> list[Chunk]:
        """Return a stage that runs on the side stream, in parallel with the stages up to the next join."""
        return self.serial(name, self.fork, *launches, self.end_fork)

    def fork(self) -> None:
        """On CUDA, put the following launches on the side stream, after everything so far."""
        if self._side_stream is not None:
            self._side_stream.wait_event(self._main_stream.record_event())
            self._device.set_stream(self._side_stream, sync=False)

    def end_fork(self) -> None:
        """On CUDA, put the following launches on the main stream again, in parallel with those since `fork`."""
        if self._side_stream is not None:
            self._fork_end = self._side_stream.record_event()
            self._device.set_stream(self._main_stream, sync=False)

    def join(self) -> None:
        """On CUDA, let the main stream wait for the launches between `fork` and `end_fork`."""
        if self._side_stream is not None:
            self._main_stream.wait_event(self._fork_end)

    def run(self) -> None:
        """Run all stages in order. On the CPU, `stage_ms` then holds the time of each stage [ms]."""
        if self._device.is_cpu:
            self._run_eagerly()
        elif self._graph is None:
            self._run_eagerly()  # loads the modules, which a capture cannot do
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                self._run_eagerly()
            self._graph = capture.graph
        else:
            wp.capture_launch(self._graph)

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

        with self._single_stream(), wp.ScopedDevice(device), wp.ScopedCapture() as capture:
            record_event("")
            launches = [launch for stage in self.stages for chunk in stage for launch in chunk]
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
        with self._single_stream(), wp.ScopedCapture(device=self._device, apic=True) as capture:
            self._run_eagerly()
        return capture.graph

    @contextmanager
    def _single_stream(self) -> Iterator[None]:
        """On CUDA, run everything on one stream."""
        side_stream, self._side_stream = self._side_stream, None
        try:
            yield
        finally:
            self._side_stream = side_stream

    def _run_eagerly(self) -> None:
        if self._side_stream is not None:
            self._main_stream = self._device.stream
        self.stage_ms = {}
        for stage in self.stages:
            chunks = deque(stage)
            helpers = min(len(chunks), self._workers) - 1
            futures = (
                [self._executor.submit(self._run_chunks, chunks, {}) for _ in range(helpers)] if self._executor else []
            )
            self._run_chunks(chunks, self.stage_ms)
            started = time.perf_counter()
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
