"""Add a panel to the page: a tab with the charge of a battery, and a button that sends the drone back to the start.

`own_panel.py demo forest` has the tab, and so has the page that is served without a command.
"""

import sys

import viser

from aero_viz.catalog import open_source
from aero_viz.cli import main
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import PANELS, Panel
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

CAPACITY = 60.0 * 9.81  # thrust times time [N s]: a minute of hovering with 1 kg


class BatteryPanel(Panel):
    """Charge of a battery, by the thrust of the plans."""

    title, icon = "Battery", viser.Icon.BATTERY

    def create(self, gui: viser.GuiApi) -> None:
        self.used = self.time = 0.0
        self.charge = gui.add_progress_bar(100.0)
        home = gui.add_button("Fly back to the start")

        @home.on_click
        async def _(event: viser.GuiEvent) -> None:  # coroutines run in the order of the clicks
            controls, frame = self.session.controls, self.session.frame
            if controls is not None and frame is not None:
                self.page.attempt(lambda: controls.set_goal(frame.source.start), event.client)

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self.used = self.time = 0.0
        return []

    def update(self, frame: Frame) -> list[Change]:
        self.used += float(frame.plan.command[0, 0]) * max(frame.time - self.time, 0.0)
        self.time = frame.time
        return [(self.charge, "value", 100.0 * max(1.0 - self.used / CAPACITY, 0.0))]  # [%]


PANELS.add("battery", BatteryPanel)

if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(main())
    session = Session(open_source("forest", seed=3))
    dashboard = Dashboard(session, port=0)  # port 0: any free port
    session.start()
    print(dashboard.url)
    input("Press Enter to stop. ")
    dashboard.close()
    session.close()
