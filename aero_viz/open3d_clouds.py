"""Open3D, imported where it is needed: it takes a second."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError


def import_open3d() -> Any:
    """Return the module open3d, silenced.

    Raises:
        UserError: it cannot be loaded; says how to install it.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise UserError(
            f"This needs Open3D, which cannot be loaded ({error}): run pip install open3d-cpu, and install its system "
            "libraries (Debian, Ubuntu: sudo apt-get install libegl1 libgl1 libgomp1 libusb-1.0-0)."
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def point_cloud(points: NDArray[np.floating]) -> Any:
    """Return points [n, 3] as a cloud of Open3D."""
    open3d = import_open3d()
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.ascontiguousarray(points, np.float64)))
