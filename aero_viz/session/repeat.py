"""Repeats the ticks of a session on a separate source, to write them to a file while the session flies on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from aero_planner.config import DroneConfig
from aero_viz.session.config_history import ConfigHistory
from aero_viz.session.engine import Engine
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source
from aero_viz.session.timeline import Checkpoint


def repeat(
    source: Source, ticks: Iterable[tuple[Checkpoint, DroneConfig]], *, device: str, seed: int
) -> Iterator[Frame]:
    """Yield the frames of ticks that a session has flown, see `Session.flown`. They are the same bit for bit.

    Args:
        source: takes the checkpoints of the session's source, such as `FlightSource.twin`; closed at the end.
        ticks: the ticks, in the order of time.
        device: Warp device of the planner, that of the session.
        seed: seed of the session's planner.
    """
    engine: Engine | None = None
    configs: ConfigHistory | None = None
    try:
        for checkpoint, config in ticks:
            if configs is None:
                configs = ConfigHistory(config)
            configs.change(config)
            if engine is None:
                engine = Engine(source, configs=configs, device=device, seed=seed, publish=lambda _: None)
            yield engine.repeat(checkpoint)
    finally:
        source.close() if engine is None else engine.close()
