"""Parameters of the unseen space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from aero_planner.config.field_of_view import VIEW_FORM, VIEW_PATTERN, VIEWS, View, parse_views
from aero_planner.parameters import ParameterSection, live, table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def pack_views(text: str) -> NDArray[np.float32]:
    """Return the views of a text, a row for each, with zeros where there is none, [VIEWS, 4]."""
    import numpy as np  # the command line needs the names of the parameters only

    rows = np.zeros((VIEWS, 4), np.float32)
    views = parse_views(text)
    rows[: len(views)] = views
    return rows


@dataclass(frozen=True)
class Parameters(ParameterSection, section="unseen_space"):
    """Unseen space: surfaces continue beyond the edges of the field of view."""

    view: str = table(
        "-7 52", VIEW_PATTERN, VIEW_FORM, pack_views, "What the sensors see, body frame [deg]: lowest and highest "
        "elevation, width and middle in azimuth, positive to the left; a second view follows a semicolon, as in "
        "-29 29 87; -29 29 87 180. What lies beside is unknown; with a narrow view, the drone looks where it flies.",
        label="Field of view",
    )  # fmt: skip
    continuation: float = live(
        20.0, "m", 0.0, 20.0, "Length by which a surface at the lower or upper edge of the field of view is continued "
        "down or up, into empty cells that the sensor does not see. 0: unseen space is free.",
        label="Continuation of surfaces",
    )  # fmt: skip
    view_age: float = live(
        0.1, "s", 0.0, 1.0, "Time since the sensor has seen all of its field of view. The drone moves meanwhile, so "
        "that surfaces near the edges of the field of view are continued as well.",
        label="Age of the view",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            parse_views(self.view)
        except ValueError as error:
            raise ValueError(f"unseen_space.view has {error}.") from None

    @property
    def views(self) -> tuple[View, ...]:
        """The fields of view of the sensors."""
        return parse_views(self.view)
