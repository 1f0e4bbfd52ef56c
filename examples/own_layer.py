"""Add a layer to the dashboard: an arrow that shows the planned thrust of the drone."""

import numpy as np
import viser

from aero_planner.quaternions import rotate
from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers import LAYERS, Change, ColorKey, Layer
from aero_viz.session import Session
from aero_viz.session.frame import Frame

COLOR = (255, 160, 0)
SCALE = 0.1  # [m/N]


class ThrustLayer(Layer):
    """The first planned thrust as a line from the drone."""

    name, title = "thrust", "Planned thrust"
    keys = (ColorKey("planned thrust, 1 m for 10 N", COLOR),)  # in the legend

    def create(self, scene: viser.SceneApi) -> None:
        empty = np.zeros((1, 2, 3), dtype=np.float32)
        colors = np.full((1, 2, 3), COLOR, dtype=np.uint8)
        self.line = scene.add_line_segments("/thrust/line", empty, colors, thickness=4.0, thickness_units="screen")

    def update(self, frame: Frame) -> list[Change]:
        state = frame.observation.actual_state
        position = np.asarray(state.position)
        thrust = rotate(state.quaternion, [0.0, 0.0, frame.plan.command[0, 0]])  # [N], world frame
        segment = np.stack((position, position + SCALE * thrust))[None]
        return [(self.line, "points", segment.astype(np.float32))]


session = Session(open_source("forest", seed=3))
dashboard = Dashboard(session, port=0, layers=(*LAYERS.values(), ThrustLayer))  # port 0: any free port
session.start()
print(dashboard.url)
input("Press Enter to stop. ")
dashboard.close()
session.close()
