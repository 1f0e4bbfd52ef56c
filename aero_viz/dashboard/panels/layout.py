"""Layout of the page: its tabs, in their order. A new panel needs its module and a place in one of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import viser

from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.panels.appearance import AppearancePanel
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.camera import CameraPanel
from aero_viz.dashboard.panels.compare import ComparePanel
from aero_viz.dashboard.panels.configuration import Baseline, ConfigurationPanel
from aero_viz.dashboard.panels.curves import CurvePanel
from aero_viz.dashboard.panels.disturbances import DisturbancePanel
from aero_viz.dashboard.panels.drone_tuning import DroneTuningPanel
from aero_viz.dashboard.panels.finder import FinderPanel
from aero_viz.dashboard.panels.goal import GoalPanel
from aero_viz.dashboard.panels.health import HealthPanel
from aero_viz.dashboard.panels.layers import LayerPanel
from aero_viz.dashboard.panels.live import LiveOffer, LivePanel
from aero_viz.dashboard.panels.mission import MissionPanel
from aero_viz.dashboard.panels.obstacles import ObstaclePanel
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.dashboard.panels.page_copy import PageCopies
from aero_viz.dashboard.panels.parameters import ParameterPanel, ParameterTablePanel
from aero_viz.dashboard.panels.playback import PlaybackPanel
from aero_viz.dashboard.panels.post_mortem import PostMortemPanel
from aero_viz.dashboard.panels.returning import ReturningVisitors
from aero_viz.dashboard.panels.seeds import SeedsPanel
from aero_viz.dashboard.panels.sensitivity import SensitivityPanel
from aero_viz.dashboard.panels.share import Files, SharePanel
from aero_viz.dashboard.panels.shortcuts import Action, ShortcutPanel
from aero_viz.dashboard.panels.source import SourcePanel
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.dashboard.panels.study import StudyPanel
from aero_viz.dashboard.panels.title import TitlePanel
from aero_viz.dashboard.panels.visitors import VisitorPanel
from aero_viz.dashboard.panels.why import WhyPanel
from aero_viz.errors import UserError
from aero_viz.live.session import StreamSession
from aero_viz.registry import Registry
from aero_viz.session.base import SessionControls
from aero_viz.session.source import Conditions, Opener
from aero_viz.study_view import Study


@dataclass(frozen=True)
class Offer:
    """What the panels of a page offer, see the arguments of `Dashboard`."""

    open_source: Opener | None
    choices: Sequence[tuple[str, str]]
    seed: int
    folders: Folders
    opened: str = ""
    conditions: Conditions | None = None
    files: Files | None = None
    study: Study | None = None
    live: LiveOffer | None = None


@dataclass(frozen=True)
class Desk:
    """What a tab is built from."""

    page: Page
    offer: Offer
    camera: CameraPanel
    open_tabs: OpenTabs
    actions: dict[str, Action]
    """What keys do, by name; a tab adds its own."""
    sources: list[SourcePanel] = field(default_factory=list)
    """The panel that opens sources, once its tab is built."""

    @property
    def controls(self) -> SessionControls:
        """Controls of the session, for tabs of a page that has them."""
        controls = self.page.session.controls
        assert controls is not None
        return controls


@dataclass(frozen=True)
class Tab:
    """One tab of the page."""

    title: str
    icon: viser.IconName
    build: Callable[[Desk, viser.GuiTabHandle], list[Panel]]
    """Creates the panels in the open tab."""
    is_there: Callable[[Desk], bool] = lambda desk: True
    """Returns whether a page has the tab."""


def _is_controlled(desk: Desk) -> bool:
    return desk.page.session.controls is not None


def _fly(desk: Desk, _: viser.GuiTabHandle) -> list[Panel]:
    page, offer, controls = desk.page, desk.offer, desk.page.session.controls
    gui, panels = page.server.gui, []
    if controls is None:
        return []
    if offer.open_source is not None:
        with gui.add_folder("Source"):
            options: dict[str, Any] = {"seed": offer.seed, "opened": offer.opened, "conditions": offer.conditions}
            sources = SourcePanel(page, controls, offer.open_source, offer.choices, offer.folders, **options)
            panels.append(sources)
            desk.sources.append(sources)
        if offer.files is not None:
            with gui.add_folder("Share", expand_by_default=False):
                copies = PageCopies(page, desk.camera)
                panels += [copies, SharePanel(page, controls, sources, offer.files, copies)]
    with gui.add_folder("Goal"):
        panels.append(GoalPanel(page, controls))
    with gui.add_folder("Mission", expand_by_default=False):
        panels.append(MissionPanel(page, controls, desk.open_tabs))
    return panels


def _live(desk: Desk, _: viser.GuiTabHandle) -> list[Panel]:
    session, offer = desk.page.session, desk.offer.live
    assert isinstance(session, StreamSession) and offer is not None
    return [LivePanel(desk.page, session, offer)]


def _world(desk: Desk, _: viser.GuiTabHandle) -> list[Panel]:
    page, controls = desk.page, desk.controls
    obstacles = ObstaclePanel(page, controls, desk.open_tabs)
    desk.actions.update(throw=lambda _: obstacles.throw(), remove=lambda _: obstacles.remove())
    with page.server.gui.add_folder("Wind, faults, drone") as folder:
        return [obstacles, DisturbancePanel(page, controls, folder)]


def _why(desk: Desk, _: viser.GuiTabHandle) -> list[Panel]:
    return [PostMortemPanel(desk.page, desk.controls), WhyPanel(desk.page, desk.open_tabs), SensitivityPanel(desk.page)]


def _layers(desk: Desk, tab: viser.GuiTabHandle) -> list[Panel]:
    panel = LayerPanel(desk.page, tab)
    desk.actions["layer"] = panel.toggle
    return [panel]


def _tune(desk: Desk, tab: viser.GuiTabHandle) -> list[Panel]:
    page, controls = desk.page, desk.page.session.controls
    if controls is None:
        own: list[Panel] = [] if page.session.tuning is None else [DroneTuningPanel(page)]
        return [*own, ParameterTablePanel(page)]
    baseline = Baseline.from_config(page.session.config)
    panels: list[Panel] = [HealthPanel(page, controls), ComparePanel(page, controls, desk.offer.folders)]
    panels += [SeedsPanel(page, controls, sources) for sources in desk.sources]
    return [*panels, ConfigurationPanel(page, controls, baseline), ParameterPanel(page, controls, baseline, tab)]


def _study(desk: Desk, _: viser.GuiTabHandle) -> list[Panel]:
    assert desk.offer.study is not None
    return [StudyPanel(desk.page, desk.controls, desk.offer.study)]


def _accept(name: str, found: Any) -> Tab:
    """Return a `Tab`, or that of a panel with a title of its own."""
    if isinstance(found, Tab):
        return found
    if not (isinstance(found, type) and issubclass(found, Panel) and found.title):
        raise UserError(
            f"{name} is not a panel; give a class derived from aero_viz.dashboard.panels.Panel with a title."
        )
    return Tab(found.title, found.icon, lambda desk, _: [found(desk.page)])


PANELS: Registry[Tab] = Registry(
    "panel",
    "aero_viz.panels",
    {
        "fly": Tab("Fly", viser.Icon.DRONE, _fly),
        "live": Tab("Live", viser.Icon.ANTENNA, _live, lambda desk: desk.offer.live is not None),
        "world": Tab("World", viser.Icon.TREES, _world, _is_controlled),
        # The frames of a drone hold too little to explain them.
        "why": Tab("Why", viser.Icon.QUESTION_MARK, _why, _is_controlled),
        "layers": Tab("Layers", viser.Icon.STACK_2, _layers),
        "tune": Tab("Tune", viser.Icon.ADJUSTMENTS, _tune),
        "study": Tab(
            "Study", viser.Icon.CHART_DOTS, _study, lambda desk: _is_controlled(desk) and desk.offer.study is not None
        ),
    },
    _accept,
)
"""All tabs by name, in the order of the page."""


def build(page: Page, offer: Offer) -> tuple[CameraPanel, list[Panel]]:
    """Create all panels: the tabs docked on the right, the status floating at the lower left, curves below.

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
    shown = dict(PANELS)
    panels.append(open_tabs := OpenTabs(page, [tab.title for tab in shown.values()]))
    desk = Desk(page, offer, camera, open_tabs, actions)
    tabs = gui.add_tab_group()
    offered = {name: tab for name, tab in shown.items() if tab.is_there(desk)}
    for name, tab in offered.items():
        with tabs.add_tab(tab.title, tab.icon) as handle:
            panels += PANELS.made(name, lambda tab, handle=handle: tab.build(desk, handle)) or []
    status = gui.add_panel()
    with status.add_tab("Planner", viser.Icon.GAUGE):
        panels.append(state := StatusPanel(page))
    with status.add_tab("Legend", viser.Icon.PALETTE):
        state.create_details(gui)
    status.float(x=15, y=-15, width=310)
    panels.append(CurvePanel(page, playback.seek))
    # Before the others, which forget what a visitor who leaves has chosen.
    return camera, [
        ReturningVisitors(page, camera),
        *panels,
        camera,
        appearance,
        TitlePanel(page),
        ShortcutPanel(page, actions),
        FinderPanel(
            page,
            [*(tab.title for tab in offered.values()), "Planner", "Legend"],
            actions.get("layer"),
            next(((panel, shown["tune"].title) for panel in panels if isinstance(panel, ParameterPanel)), None),
        ),
    ]
