"""The choice of one sensor where several were recorded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from aero_viz.errors import UserError
from aero_viz.recordings.bag_file import list_names


def choose_sensor(points: Mapping[str, int | None], wanted: str | None, place: str | Path) -> tuple[str, str]:
    """Return the name of the sensor to play, and a notice on the others; empty if there are none.

    Points of several sensors are not mixed, because each has its own place and its own clock.

    Args:
        points: numbers of points by the name of their sensor, None where they are not known; at least one.
        wanted: the name that the user gave, or a part of one name only; None takes the sensor with the most points.
        place: what they were recorded in, for messages.

    Raises:
        UserError: no sensor, or more than one, has this name.
    """
    names = sorted(points, key=lambda name: (-(points[name] or 0), name))
    texts = {name: name if count is None else f"{name} ({count} points)" for name, count in points.items()}
    found = names
    if wanted is not None:
        found = [name for name in names if name == wanted] or [name for name in names if wanted and wanted in name]
        if len(found) != 1:
            problem = f"several sensors fit --sensor {wanted}" if found else f"no sensor is called {wanted}"
            raise UserError(f"{place}: {problem}; choose one of {list_names([texts[name] for name in names])}.")
    if len(names) < 2:
        return found[0], ""
    others = list_names([texts[name] for name in names if name != found[0]])
    return found[0], f"of {len(names)} sensors, {texts[found[0]]} is played; --sensor plays {others}"
