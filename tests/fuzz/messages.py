"""Messages for the page's websocket: those that a page may send, with random fields, values and damage."""

from typing import Any

import msgspec
import numpy as np
from fuzz.mutation import mutate, pack

COUNT = 200
"""Messages of a case."""
IDENTIFIERS = tuple(f"{number:036}" for number in range(1000))
"""Stand-ins for the identifiers of the controls, which a page draws anew; of the same length."""

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2.5, 1e30, -(1 << 63), (1 << 64) - 1, float("nan"), float("inf"), "", "forest", "+10",
    "../../etc/passwd", "\u0000\ud7ff", "x" * 6000, b"\x00\xff", [], [1.0, 2.0, 3.0], [None] * 3, [[1.0]] * 2, {},
    {"value": 1},
)  # fmt: skip
_FIELDS: dict[str, tuple[str, ...]] = {
    "ViewerCameraMessage": (
        "wxyz", "position", "fov", "near", "far", "image_height", "image_width", "look_at", "up_direction",
    ),
    "AeroNumberMessage": ("uuid", "index", "text", "is_over"),
    "GuiFormSubmitMessage": ("uuid",),
    "GuiFormDirtyMessage": ("uuid",),
    "CommandTriggerMessage": ("uuid",),
    "GuiButtonHoldMessage": ("uuid", "frequency"),
    "FileTransferStartUpload": (
        "source_component_uuid", "transfer_uuid", "filename", "mime_type", "part_count", "size_bytes",
    ),
    "FileTransferPart": ("source_component_uuid", "transfer_uuid", "part_index", "content"),
    "GetRenderResponseMessage": ("payload", "render_uuid"),
    "LocalStorageGetItemResponseMessage": ("value", "error", "request_uuid"),
    "ShareUrlRequest": (),
    "TransformControlsUpdateMessage": ("name", "wxyz", "position", "owner"),
    "TransformControlsDragStartMessage": ("name", "owner"),
    "SceneNodeClickMessage": ("name", "instance_index", "ray_origin", "ray_direction", "screen_pos", "modifier"),
    "ScenePointerMessage": ("event_type", "ray_origin", "ray_direction", "screen_pos", "modifier"),
}  # fmt: skip


def generate(random: np.random.Generator) -> bytes:
    """Return the messages of a case."""
    return pack([_message(random) for _ in range(COUNT)])


def _message(random: np.random.Generator) -> bytes:
    def identifier() -> str:
        if random.random() < 0.1:
            return ("/goal_arrows", "/drone", "")[int(random.integers(3))]
        return IDENTIFIERS[int(random.integers(len(IDENTIFIERS)))]

    def value() -> Any:
        if random.random() < 0.3:
            return identifier()
        if random.random() < 0.3:
            return [float(x) for x in random.normal(0.0, 3.0, int(random.integers(2, 5)))]
        return _VALUES[int(random.integers(len(_VALUES)))]

    if random.random() < 0.5:
        name = "value" if random.random() < 0.9 else str(value())
        content: dict[str, Any] = {"type": "GuiUpdateMessage", "uuid": identifier(), "updates": {name: value()}}
    else:
        kind = list(_FIELDS)[int(random.integers(len(_FIELDS)))]
        content = {"type": kind} | {name: value() for name in _FIELDS[kind] if random.random() < 0.97}
    data = msgspec.msgpack.encode(content)
    return mutate(data, random) if random.random() < 0.3 else data
