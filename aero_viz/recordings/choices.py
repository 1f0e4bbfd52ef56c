"""What a user may settle about a recording before it is opened."""

from __future__ import annotations

from typing import Literal, NamedTuple

CloudFrame = Literal["auto", "body", "world"]


class Choices(NamedTuple):
    """Choices that the readers of files make by themselves where they are None or "auto"."""

    columns: str | None = None
    """Rows of .bin files, see `aero_viz.recordings.bin_files.parse_columns`."""
    sensor: str | None = None
    """Name of the sensor to play, where several were recorded in one capture or on one topic."""
    cloud_frame: CloudFrame = "auto"
    """What the clouds move with; "auto" goes by the name of their frame."""


AUTOMATIC = Choices()
"""Nothing is settled."""
