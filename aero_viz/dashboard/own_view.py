"""What one visitor alone sees of the controls that all share, which viser does not offer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.viser_private import identifier, show


class _Own:
    """A control as one visitor sees it."""

    def __init__(self, client: viser.ClientHandle, handle: Any) -> None:
        self._client, self._handle = client, handle

    def _show(self, visible: bool) -> None:
        show(self._client, identifier(self._handle), visible=visible)

    visible = property(fset=_show)


class OwnView:
    """Shows and hides shared controls for one visitor. The program must not change `visible` of these controls itself.

    Args:
        client: the visitor.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._shown: dict[int, bool] = {}
        """What the visitor sees, by the identity of the handle: handles of viser have no hash."""

    def show(self, controls: Iterable[tuple[Any, bool]]) -> list[Change]:
        """Return the changes that show or hide controls for the visitor."""
        changed = [(h, visible) for h, visible in controls if self._shown.get(id(h), h.visible) != visible]
        self._shown |= {id(handle): visible for handle, visible in changed}
        return [(_Own(self._client, handle), "visible", visible) for handle, visible in changed]
