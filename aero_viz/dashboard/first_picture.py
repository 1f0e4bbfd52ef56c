"""The first picture of a session, which a page draws before it gets the panels and all other layers."""

from __future__ import annotations

import time
from collections.abc import Callable

from aero_viz.dashboard.layers import Change, Layer, apply
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.panels.camera import Viewpoints
from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.viser_private import wait_until_drawn
from aero_viz.session.base import BaseSession

_WAIT_MAX = 3.0
"""Longest wait for a plan and for a visitor [s]. Kernels that must be compiled, or a visitor, may take minutes."""
_POLL_PERIOD = 0.01


def show_first_picture(session: BaseSession, server: LocalServer, *, is_over: Callable[[], bool]) -> list[Layer]:
    """Show the first visitor the points and the rollouts, and return their layers when they are drawn.

    A page draws them in half of the time that it needs for everything. Without a plan or without a visitor, the layers
    are returned after a few seconds.

    Args:
        session: running session.
        server: server without any layers.
        is_over: called while waiting for a plan or a visitor; True ends that wait.
    """
    layers: list[Layer] = [CloudLayer(server), RolloutLayer(server)]
    deadline = time.monotonic() + _WAIT_MAX

    def wait_for(condition: Callable[[], object]) -> bool:
        while not condition():
            if is_over() or time.monotonic() > deadline:
                return False
            time.sleep(_POLL_PERIOD)
        return True

    if not wait_for(lambda: session.frame is not None):
        return layers
    frame = session.frame
    assert frame is not None
    eye, look_at = Viewpoints().find("follow", frame)
    # For a visitor who comes later, and for one who is already there.
    cameras = [server.initial_camera, *(client.camera for client in server.get_clients().values())]
    changes: list[Change] = [
        change for camera in cameras for change in ((camera, "position", eye), (camera, "look_at", look_at))
    ]
    for layer in layers:
        layer.eyes = [eye]
        changes += layer.show(frame)
    with server.atomic():
        apply(changes)
    server.flush()
    if wait_for(server.get_clients):
        for client in list(server.get_clients().values())[:1]:
            wait_until_drawn(client)
    return layers
