"""Layout of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import viser

from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.panels.appearance import AppearancePanel
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.camera import CameraPanel
from aero_viz.dashboard.panels.charts import ChartPanel
from aero_viz.dashboard.panels.compare import ComparePanel
from aero_viz.dashboard.panels.configuration import Baseline, ConfigurationPanel
from aero_viz.dashboard.panels.disturbances import DisturbancePanel
from aero_viz.dashboard.panels.goal import GoalPanel
from aero_viz.dashboard.panels.health import HealthPanel
from aero_viz.dashboard.panels.layers import LayerPanel
from aero_viz.dashboard.panels.obstacles import ObstaclePanel
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.dashboard.panels.page_copy import PageCopies
from aero_viz.dashboard.panels.parameters import ParameterPanel, ParameterTablePanel
from aero_viz.dashboard.panels.playback import PlaybackPanel
from aero_viz.dashboard.panels.post_mortem import PostMortemPanel
from aero_viz.dashboard.panels.returning import ReturningVisitors
from aero_viz.dashboard.panels.seeds import FlySeeds, SeedsPanel
from aero_viz.dashboard.panels.sensitivity import SensitivityPanel
from aero_viz.dashboard.panels.share import Files, SharePanel
from aero_viz.dashboard.panels.shortcuts import Action, ShortcutPanel
from aero_viz.dashboard.panels.source import SourcePanel
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.dashboard.panels.study import StudyPanel
from aero_viz.dashboard.panels.title import TitlePanel
from aero_viz.dashboard.panels.visitors import VisitorPanel
from aero_viz.dashboard.panels.why import WhyPanel
from aero_viz.session.source import Conditions, Opener

if TYPE_CHECKING:
    from aero_viz.evaluation.tune import StoredStudy

_TABS = ("Fly", "World", "Curves", "Why", "Layers", "Tune", "Study", "Parameters")
"""Names of the tabs that a page may have."""


def build(
    page: Page,
    *,
    open_source: Opener | None,
    choices: Sequence[tuple[str, str]],
    seed: int,
    folders: Folders,
    opened: str = "",
    conditions: Conditions | None = None,
    files: Files | None = None,
    study: StoredStudy | None = None,
    fly_seeds: FlySeeds | None = None,
) -> tuple[CameraPanel, list[Panel]]:
    """Create all panels: the controls docked on the right, the status floating at the lower left.

    Without `session.controls`, there are no panels that change the session.
    """
    gui, controls = page.server.gui, page.session.controls
    gui.main_panel.dock_right()
    gui.main_panel.set_width(350)
    panels: list[Panel] = [VisitorPanel(page), playback := PlaybackPanel(page)]
    camera, appearance = CameraPanel(page), AppearancePanel(page)
    actions: dict[str, Action] = {
        "theme": appearance.toggle,
        "play": lambda _: playback.toggle(),
        "step": lambda _, count: playback.step(count),
        "camera": camera.select,
    }
    if controls is not None:
        actions |= {"undo": lambda _: controls.undo(), "redo": lambda _: controls.redo()}
    panels.append(open_tabs := OpenTabs(page, _TABS))
    sources: SourcePanel | None = None
    tabs = gui.add_tab_group()
    with tabs.add_tab("Fly", viser.Icon.DRONE):
        if controls is not None and open_source is not None:
            with gui.add_folder("Source"):
                options: dict[str, Any] = {"seed": seed, "opened": opened, "conditions": conditions}
                sources = SourcePanel(page, controls, open_source, choices, folders, **options)
                panels.append(sources)
            if files is not None:
                with gui.add_folder("Share", expand_by_default=False):
                    panels += [copies := PageCopies(page, camera), SharePanel(page, controls, sources, files, copies)]
        if controls is not None:
            with gui.add_folder("Goal"):
                panels.append(GoalPanel(page, controls))
    if controls is not None:
        with tabs.add_tab("World", viser.Icon.TREES):
            panels.append(obstacles := ObstaclePanel(page, controls, open_tabs))
            actions |= {"throw": lambda _: obstacles.throw(), "remove": lambda _: obstacles.remove()}
            with gui.add_folder("Wind, faults, drone") as folder:
                panels.append(DisturbancePanel(page, controls, folder))
    with tabs.add_tab("Curves", viser.Icon.CHART_LINE):
        panels.append(ChartPanel(page))
    if controls is not None:  # the frames of a drone hold too little to explain them
        with tabs.add_tab("Why", viser.Icon.QUESTION_MARK):
            panels += [PostMortemPanel(page, controls), WhyPanel(page, open_tabs), SensitivityPanel(page)]
    with tabs.add_tab("Layers", viser.Icon.STACK_2) as tab:
        panels.append(layers := LayerPanel(page, tab))
        actions["layer"] = layers.toggle
    if controls is not None:
        with tabs.add_tab("Tune", viser.Icon.ADJUSTMENTS) as tune:
            baseline = Baseline.from_config(page.session.config)
            panels += [HealthPanel(page, controls), ComparePanel(page, controls)]
            if sources is not None and fly_seeds is not None:
                panels.append(SeedsPanel(page, controls, sources, fly_seeds))
            panels.append(ConfigurationPanel(page, controls, baseline))
            panels.append(ParameterPanel(page, controls, baseline, tune))
        if study is not None:
            with tabs.add_tab("Study", viser.Icon.CHART_DOTS):
                panels.append(StudyPanel(page, controls, study))
    else:
        with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
            panels.append(ParameterTablePanel(page))
    status = gui.add_panel()
    with status.add_tab("Planner", viser.Icon.GAUGE):
        panels.append(state := StatusPanel(page))
    with status.add_tab("Legend", viser.Icon.PALETTE):
        state.create_details(gui)
    status.float(x=15, y=-15, width=310)
    # Before the others, which forget what a visitor who leaves has chosen.
    return camera, [
        ReturningVisitors(page, camera),
        *panels,
        camera,
        appearance,
        TitlePanel(page),
        ShortcutPanel(page, actions),
    ]
