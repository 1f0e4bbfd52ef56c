"""Durations of the stages of a tick, on CUDA between events."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp


class StageTimer:
    """Measures named stages on a device without making the host wait for it.

    Args:
        device: Warp device of the stages.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._seconds: dict[str, float] = {}
        self._events: list[tuple[str, wp.Event, wp.Event]] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent in the context to a stage."""
        if self._device.is_cuda:
            started, ended = (wp.Event(self._device, enable_timing=True) for _ in range(2))
            self._device.stream.record_event(started)
            yield
            self._device.stream.record_event(ended)
            self._events.append((name, started, ended))
        else:
            started_at = time.perf_counter()
            yield
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - started_at

    def total_ms(self) -> dict[str, float]:
        """Return the time of each stage so far [ms]; waits for the device."""
        total = {name: 1e3 * seconds for name, seconds in self._seconds.items()}
        for name, started, ended in self._events:
            total[name] = total.get(name, 0.0) + float(wp.get_event_elapsed_time(started, ended))
        return total
