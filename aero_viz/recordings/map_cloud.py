"""The only cloud of a bag, as the map of a world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError
from aero_viz.recordings.clouds import read_cloud
from aero_viz.recordings.contents import read_contents
from aero_viz.recordings.storage import open_storage, readable
from aero_viz.recordings.topics import choose_cloud_topic


def read_map_cloud(path: str | Path) -> NDArray[np.float64]:
    """Return the points of a bag that holds one cloud [n, 3] [m], such as a map, without invalid ones.

    Args:
        path: file or folder.

    Raises:
        UserError: there is no recording, it has more than one cloud, or the cloud has no valid point.
    """
    storage = open_storage(path)
    try:
        with readable(storage.path):
            contents = read_contents(storage)
            chosen, _ = choose_cloud_topic(contents, None)
            if len(chosen.clouds) != 1:
                raise UserError(f"{chosen.name} of {path} has {len(chosen.clouds)} clouds, and a map is a single one.")
            entry = chosen.clouds[0]
            rows = read_cloud(entry.file.read(entry.position), chosen.type, chosen.encoding).rows.reshape(-1)
    finally:
        storage.close()
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
    if not len(points):
        raise UserError(f"{path} holds a cloud without valid points on {chosen.name}; record it again.")
    return points
