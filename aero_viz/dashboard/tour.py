"""A tour for an exhibition screen: scenes in sequence, with captions and a moving camera."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard.dashboard import Dashboard
from aero_viz.dashboard.layers import LAYERS
from aero_viz.dashboard.outlook import Outlook, Sight, has_hit_ground
from aero_viz.dashboard.viser_private import run_script
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from aero_viz.session.source import Conditions, Opener

_log = logging.getLogger(__name__)
_PERIOD = 0.25
"""Time between two polls of the flight [s]."""
_STILL_MAX = 30.0
"""Time without a tick after which a flight counts as failed [s]."""
_READING = 0.5
"""Share of a scene's longest time after which every caption has been shown: most flights are shorter."""
_SMOOTHING = 0.7
"""Time constant of the camera [s]."""
_BASE = ("drone", "trail", "goal", "obstacles", "ground")
_SHOTS = {"chase": (5.2, 24.0, 0.0, 25.0), "orbit": (7.0, 22.0, 14.0, 0.0), "top": (17.0, 75.0, 3.0, 0.0),
          "ground": (3.5, 8.0, 8.0, 0.0)}  # fmt: skip
"""Per shot: distance [m], elevation [deg], turn [deg/s], and amplitude of a slow sway [deg]."""

_CAPTION = """
let box = document.getElementById("aero-caption");
if (!box) {
  const style = document.createElement("style");
  style.textContent = ".mantine-Paper-root, .mantine-Notification-root {display: none !important}";
  document.head.append(style);
  box = document.createElement("div");
  box.id = "aero-caption";
  box.style.cssText = "position:fixed;left:4vw;right:4vw;bottom:5vh;z-index:50;pointer-events:none;color:#fff;" +
    "font:600 clamp(18px,2.6vw,44px)/1.25 system-ui,sans-serif;text-shadow:0 1px 8px #000,0 0 2px #000";
  for (const part of ["title", "text"]) {
    const line = document.createElement("div");
    line.id = "aero-caption-" + part;
    box.append(line);
  }
  box.firstChild.style.cssText = "font-size:60%;opacity:.75;font-weight:400";
  document.body.append(box);
}
const [title, text] = CONTENT;
document.getElementById("aero-caption-title").textContent = title;
document.getElementById("aero-caption-text").textContent = text;
"""
"""Script that shows a caption over the scene and hides the panels."""

Point = NDArray[np.float64]


@dataclass(frozen=True)
class Stop:
    """One scene of a tour."""

    scene: str
    captions: tuple[str, ...]
    """Sentences that are shown one after the other, for equal parts of the time."""
    shot: str = "chase"
    """Name of a camera shot: "chase", "orbit" or "top"."""
    layers: tuple[str, ...] = ("rollouts",)
    """Layers to show besides the drone, its trail, the goal, the obstacles and the ground."""
    count: int | None = None
    """Number of obstacles; None is the scene's own."""
    seconds: float = 16.0
    """Longest time to show [s]."""
    seed: int | None = None
    """Seed; None gives another world in each round."""


STOPS = (
    Stop(
        "forest",
        (
            "This drone has no map. It sees its surroundings with a LiDAR and plans fifty times per second.",
            "Each curve is a possible future. The green one costs least and is flown.",
        ),
    ),
    Stop(
        "verticals",
        (
            "300 columns that it has never seen.",
            "Points are what the LiDAR has measured: what a column occludes is unknown.",
        ),
        layers=("rollouts", "cloud"),
        count=300,
    ),
    Stop(
        "inclines",
        (
            "Fifteen directions are tried at once.",
            "Blue lines lead to free space; the optimiser bends them around obstacles.",
        ),
        shot="orbit",
        layers=("rollouts", "guides", "anchors"),
        count=400,
    ),
    Stop("random_clutter", ("Indoors: boxes, poles and balls.", "The goal is the pale ball in a ring."), shot="orbit"),
    Stop("pillars", ("A room with pillars, seen from above.",), shot="top", layers=("rollouts", "cloud"), seconds=8.0),
    Stop(
        "double_wall_trap",
        (
            "Two walls with passages on opposite sides, under a low ceiling.",
            "Without a map the drone cannot know where a passage is: it has to search for it.",
        ),
        shot="top",
        layers=("rollouts", "cloud"),
    ),
)
"""The scenes of the tour."""


class Director:
    """Moves the camera smoothly around the drone, to where no obstacle hides it."""

    def __init__(self) -> None:
        self.shot = "chase"
        """Name of the shot."""
        self._eye: Point | None = None
        self._target: Point | None = None
        self._last: Frame | None = None
        self._is_on_ground = False
        self._outlook = Outlook(Sight())

    def __call__(self, frame: Frame) -> tuple[Point, Point]:
        """Return the position of the camera and the point that it looks at [m], each of shape [3]."""
        position = frame.drone_position
        is_cut = self._last is None or self._last.source is not frame.source or self._eye is None
        shot = "ground" if has_hit_ground(frame) else self.shot
        is_cut = is_cut or (shot == "ground") != self._is_on_ground  # time stands still after a flight
        if is_cut:
            self._outlook.reset()
        self._is_on_ground = shot == "ground"
        eye, target = self._wanted(frame, position, shot)
        step = 0.0 if is_cut or self._last is None else max(frame.time - self._last.time, 0.0)
        if not is_cut:
            assert self._eye is not None and self._target is not None
            share = 1.0 - np.exp(-step / _SMOOTHING)
            eye, target = self._eye + share * (eye - self._eye), self._target + share * (target - self._target)
        self._eye, self._target, self._last = eye, target, frame
        return position + (eye if shot == "top" else self._outlook(frame, eye)), position + target

    def _wanted(self, frame: Frame, position: Point, shot: str) -> tuple[Point, Point]:
        """Return the position of the camera and its target that a shot asks for, relative to the drone."""
        distance, elevation, turn, sway = _SHOTS[shot]
        goal = np.asarray(frame.observation.goal.position, dtype=np.float64)
        heading = np.arctan2(*(goal - position)[1::-1])
        angle = heading + np.pi + np.radians(turn * frame.time + sway * np.sin(0.4 * frame.time))
        up = np.radians(elevation)
        direction = np.array([np.cos(up) * np.cos(angle), np.cos(up) * np.sin(angle), np.sin(up)])
        ahead = 1.2 * np.array([np.cos(heading), np.sin(heading), 0.0])
        return distance * direction, ahead


class Tour:
    """Loops through scenes. A scene that fails is skipped and reported.

    Args:
        session: started session, whose configuration knows nothing about a flight.
        dashboard: its page, without panels.
        open_source: opens scenes.
        stops: the scenes, in order.
        say: called with a line about each scene.
        pause: time for which the end of a flight stays in view [s].
    """

    def __init__(
        self,
        session: Session,
        dashboard: Dashboard,
        open_source: Opener,
        *,
        stops: Sequence[Stop] = STOPS,
        say: Callable[[str], Any] = print,
        pause: float = 3.0,
    ) -> None:
        self._session, self._dashboard, self._open = session, dashboard, open_source
        self._stops, self._say, self._pause = stops, say, pause
        self._config = session.config
        self.director = Director()
        """The camera."""
        self.caption = ("AERO-Viz", "")
        """Title and text over the scene."""
        self.shown = self.skipped = 0
        """Numbers of scenes that were shown and of scenes that failed."""
        dashboard.director = self.director
        dashboard.server.on_client_connect(self._show_caption)

    def run(self, shutdown: threading.Event) -> None:
        """Show the scenes one after the other until `shutdown` is set."""
        number = 0
        while not shutdown.is_set():
            stop = self._stops[number % len(self._stops)]
            seed = stop.seed if stop.seed is not None else number // len(self._stops)
            number += 1
            try:
                self._show(stop, seed, shutdown)
                self.shown += 1
            except Exception as error:
                self.skipped += 1
                _log.debug("a scene of the tour failed", exc_info=True)
                self._say(f"{stop.scene}, seed {seed}: skipped, since it failed: {error}")
                self._set_caption(stop.scene, "This scene is skipped. The next one comes in a moment.")
                shutdown.wait(self._pause)

    def _show(self, stop: Stop, seed: int, shutdown: threading.Event) -> None:
        conditions = None if stop.count is None else Conditions(count=stop.count)
        self._set_caption(stop.scene, "")
        source = self._open(stop.scene, seed=seed, conditions=conditions)
        self.director.shot = stop.shot
        self._session.configure(config_for_flight(self._config, source.info))
        self._session.set_source(source, seed=seed).result()
        self._dashboard.show_only([*_BASE, *stop.layers])
        self._session.play()
        self._watch(stop, shutdown)
        frame = self._session.frame
        assert frame is not None
        self._say(f"{stop.scene}, seed {seed}: {frame.outcome or 'shown'} after {frame.time:.1f} s")
        self._session.pause()

    def _watch(self, stop: Stop, shutdown: threading.Event) -> None:
        """Show the captions until the flight has ended or its time is over; RuntimeError if it makes no progress."""
        moved, index, started = time.monotonic(), -1, time.monotonic()
        while not shutdown.wait(_PERIOD):
            frame = self._session.frame
            assert frame is not None
            now = time.monotonic()
            if frame.outcome is not None:
                arrived = f"Arrived after {frame.time:.1f} seconds."
                ended = f"The flight ended: {frame.outcome.replace('_', ' ')}."
                self._set_caption(stop.scene, arrived if frame.outcome == "arrived" else ended)
                shutdown.wait(self._pause)
                return
            if frame.time >= stop.seconds or now - started > 4.0 * stop.seconds:
                return
            if frame.index != index:
                moved, index = now, frame.index
            elif now - moved > _STILL_MAX:
                raise RuntimeError("no plan was computed for some seconds")
            part = int(len(stop.captions) * frame.time / (_READING * stop.seconds))
            text = stop.captions[min(part, len(stop.captions) - 1)]
            speed = np.linalg.norm(np.asarray(frame.observation.actual_state.velocity))
            self._set_caption(f"{stop.scene}   {frame.time:.0f} s   {speed:.1f} m/s", text)

    def _set_caption(self, title: str, text: str) -> None:
        if (title, text) != self.caption:
            self.caption = (title, text)
            for client in self._dashboard.server.get_clients().values():
                self._show_caption(client)

    def _show_caption(self, client: viser.ClientHandle) -> None:
        run_script(client, _CAPTION.replace("CONTENT", json.dumps(self.caption)))


assert {name for stop in STOPS for name in (*_BASE, *stop.layers)} <= set(LAYERS.shipped)
