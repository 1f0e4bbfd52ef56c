"""The messages that a page may send, and the values that its controls may take."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, TypeAlias

import msgspec
import viser

__all__ = ["FormMessage", "PageMessage", "UploadPart", "UploadStart", "ValueMessage", "decode", "is_valid"]

Name = Annotated[str, msgspec.Meta(max_length=200)]
Text = Annotated[str, msgspec.Meta(max_length=5000)]
Pair: TypeAlias = tuple[float, float]
Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


class PageMessage(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message of the page. Names and types are those of viser, with nothing else in them."""


class _Camera(PageMessage, tag="ViewerCameraMessage"):
    wxyz: Quaternion
    position: Vector
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: Vector
    up_direction: Vector


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: Any


class ValueMessage(PageMessage, tag="GuiUpdateMessage"):
    """Another value of a control; of its properties, only the value can be set."""

    uuid: Name
    updates: _Value


class FormMessage(PageMessage, tag="GuiFormDirtyMessage"):
    """A change in a form, which the server tells all other pages."""

    uuid: Name


class _FormSubmit(FormMessage, tag="GuiFormSubmitMessage"):
    pass


class _Command(PageMessage, tag="CommandTriggerMessage"):
    uuid: Name


class _ButtonHold(PageMessage, tag="GuiButtonHoldMessage"):
    uuid: Name
    frequency: float


class UploadStart(PageMessage, tag="FileTransferStartUpload"):
    """Announcement of a file."""

    source_component_uuid: Name
    transfer_uuid: Name
    filename: Name
    mime_type: Name
    part_count: Annotated[int, msgspec.Meta(ge=0)]
    size_bytes: Annotated[int, msgspec.Meta(ge=0)]


class UploadPart(PageMessage, tag="FileTransferPart"):
    """Part of an announced file."""

    source_component_uuid: Name
    transfer_uuid: Name
    part_index: Annotated[int, msgspec.Meta(ge=0)]
    content: memoryview


class _Rendering(PageMessage, tag="GetRenderResponseMessage"):
    payload: memoryview
    render_uuid: Name


class _StoredItem(PageMessage, tag="LocalStorageGetItemResponseMessage"):
    value: Text | None
    error: Text | None
    request_uuid: Name


class _ShareRequest(PageMessage, tag="ShareUrlRequest"):
    pass


class _ArrowsMove(PageMessage, tag="TransformControlsUpdateMessage"):
    name: Name
    wxyz: Quaternion
    position: Vector
    owner: Name = ""


class _ArrowsStart(PageMessage, tag="TransformControlsDragStartMessage"):
    name: Name
    owner: Name = ""


class _ArrowsEnd(_ArrowsStart, tag="TransformControlsDragEndMessage"):
    pass


class _NodeClick(PageMessage, tag="SceneNodeClickMessage"):
    name: Name
    instance_index: int | None
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: Pair
    modifier: Name | None
    owner: Name = ""


class _NodeDrag(PageMessage, tag="SceneNodeDragMessage"):
    phase: Name
    name: Name
    instance_index: int | None
    start_position: Vector
    start_screen_pos: Pair
    end_position: Vector
    end_screen_pos: Pair
    button: Name
    modifier: Name | None
    owner: Name = ""


class _Pointer(PageMessage, tag="ScenePointerMessage"):
    event_type: Name
    ray_origin: Vector | None
    ray_direction: Vector | None
    screen_pos: Annotated[tuple[Pair, ...], msgspec.Meta(max_length=2)]
    modifier: Name | None


_MESSAGES: Any = (
    _Camera | ValueMessage | FormMessage | _FormSubmit | _Command | _ButtonHold | UploadStart | UploadPart
    | _Rendering | _StoredItem | _ShareRequest | _ArrowsMove | _ArrowsStart | _ArrowsEnd | _NodeClick | _NodeDrag
    | _Pointer
)  # fmt: skip
_decoder = msgspec.msgpack.Decoder(_MESSAGES)

_NUMBER_MAX = 1e15
"""Larger numbers are no setting of anything, and a browser does not hold them exactly."""
_ROUNDING = 1e-6
"""Distance beyond a bound at which a slider may end, since browsers round to its step."""


def decode(data: bytes) -> PageMessage:
    """Return the message in a frame of the websocket.

    Raises:
        ValueError: no page sends this, or a number in it is not finite.
    """
    try:
        message: PageMessage = _decoder.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error
    if not all(map(math.isfinite, _numbers(message))):
        raise ValueError("a number is not finite")
    return message


def _numbers(message: PageMessage) -> Iterator[float]:
    for value in msgspec.structs.astuple(message):
        if isinstance(value, float):
            yield value
        elif isinstance(value, tuple):
            yield from (number for item in value for number in (item if isinstance(item, tuple) else (item,)))


def is_valid(control: Any, value: object) -> bool:
    """Return True if a page may set a control of viser to `value`: it has the type, and is within bounds or options."""
    if control.disabled:
        return False
    if isinstance(control, viser.GuiButtonHandle):
        return value is True
    if isinstance(control, viser.GuiCheckboxHandle):
        return isinstance(value, bool)
    if isinstance(control, viser.GuiTextHandle):
        return isinstance(value, str) and len(value) <= 5000
    if isinstance(control, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        return isinstance(value, str) and value in control.options
    if isinstance(control, (viser.GuiNumberHandle, viser.GuiSliderHandle)):
        whole = isinstance(control.value, int)
        return _is_number(value, control.min, control.max) and (not whole or float(value) == int(value))  # type: ignore[arg-type]
    if isinstance(control, (viser.GuiVector2Handle, viser.GuiVector3Handle)):
        return _are_numbers(value, len(control.value), control.min, control.max)
    if isinstance(control, (viser.GuiRgbHandle, viser.GuiRgbaHandle)):
        return _are_numbers(value, len(control.value), (0.0,) * 4, (255.0,) * 4)
    if isinstance(control, viser.GuiMultiSliderHandle):
        size = len(control.value)
        return _are_numbers(value, size, (control.min,) * size, (control.max,) * size)
    return False  # such as the button of an upload


def _is_number(value: object, low: float | None, high: float | None) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < _NUMBER_MAX:
        return False
    return (low is None or value >= low - _ROUNDING) and (high is None or value <= high + _ROUNDING)


def _are_numbers(value: object, count: int, low: Any, high: Any) -> bool:
    if not isinstance(value, (list, tuple)) or len(value) != count:
        return False
    return all(_is_number(x, low and low[i], high and high[i]) for i, x in enumerate(value))
