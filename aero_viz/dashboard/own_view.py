"""What one visitor alone sees of the controls that all share, which viser does not offer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import viser
from viser import _messages

from aero_viz.dashboard.layers import Change


class _Own:
    """A control as one visitor sees it."""

    def __init__(self, client: viser.ClientHandle, handle: Any) -> None:
        self._client, self._handle = client, handle

    def _show(self, visible: bool) -> None:
        message = _messages.GuiUpdateMessage(self._handle._impl.uuid, {"visible": visible})
        self._client._websock_connection.queue_message(message)

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
