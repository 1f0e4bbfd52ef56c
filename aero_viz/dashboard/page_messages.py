"""The messages that a page may send, and the values that its controls may take."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, TypeAlias

import msgspec
import viser

from aero_viz.dashboard.viser_private import commands, containers, inputs

Name = Annotated[str, msgspec.Meta(max_length=200)]
Text = Annotated[str, msgspec.Meta(max_length=5000)]
Pair: TypeAlias = tuple[float, float]
Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


class PageMessage(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message of the page. Names and types are those of viser, with nothing else in them."""


class CameraMessage(PageMessage, tag="ViewerCameraMessage"):
    """The camera of a visitor; the first message of a page."""

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


class NumberMessage(PageMessage, tag="AeroNumberMessage"):
    """What a visitor types into a number field, from the script in `number_fields.py`; viser has no such message."""

    uuid: Name
    index: Annotated[int, msgspec.Meta(ge=0)]
    """Component of a vector."""
    text: Name | None
    """The text that counts, None while it is typed or if it was given up."""
    is_over: bool


class CurvesMessage(PageMessage, tag="AeroCurvesMessage"):
    """What a visitor looks at in the curves, from the script in `curve_script.py`."""

    is_open: bool
    signals: Annotated[tuple[Name, ...], msgspec.Meta(max_length=200)] | None
    """Names of the signals; None are those shown at first."""
    span: Pair | None
    """Times that are looked at [s]; None is the whole flight."""
    width: Annotated[int, msgspec.Meta(ge=0, le=10_000)]
    """Width of the curves [pixels]."""


class CurvesSaveMessage(PageMessage, tag="AeroCurvesSaveMessage"):
    """A request for the curves as a file."""


class SeekMessage(PageMessage, tag="AeroSeekMessage"):
    """A click on the curves: go to a time [s]."""

    time: float


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


MESSAGES: Any = (
    CameraMessage | ValueMessage | NumberMessage | CurvesMessage | CurvesSaveMessage | SeekMessage | FormMessage
    | _FormSubmit | _Command | _ButtonHold | UploadStart | UploadPart | _Rendering | _StoredItem | _ShareRequest
    | _ArrowsMove | _ArrowsStart | _ArrowsEnd | _NodeClick | _NodeDrag | _Pointer
)  # fmt: skip
_decoder = msgspec.msgpack.Decoder(MESSAGES)

NUMBER_MAX = 1e15
"""No setting is larger, and a browser does not store larger numbers exactly."""
_TEXT_MAX = 5000
"""Length of the longest text; no path is longer."""


def decode(data: bytes) -> PageMessage:
    """Return the message in a frame of the websocket.

    Raises:
        ValueError: no page sends this, or a number in it is not finite.
    """
    try:
        message: PageMessage = _decoder.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(str(error)) from error
    if not all(map(math.isfinite, _numbers(msgspec.structs.astuple(message)))):
        raise ValueError("a number is not finite")
    return message


def is_own(message: PageMessage, client: viser.ClientHandle | None) -> bool:
    """Return True if a message concerns its sender alone: the camera, an answer, or what only this client sees."""
    if isinstance(message, (CameraMessage, CurvesMessage, CurvesSaveMessage, _Rendering, _StoredItem)):
        return True
    if client is None:
        return False
    if isinstance(message, (ValueMessage, NumberMessage, _ButtonHold)):
        return message.uuid in inputs(client.gui)
    if isinstance(message, FormMessage):
        return message.uuid in containers(client.gui)
    if isinstance(message, _Command):
        return message.uuid in commands(client.gui)
    if isinstance(message, (UploadStart, UploadPart)):
        return message.source_component_uuid in inputs(client.gui)
    return getattr(message, "owner", "") == str(client.client_id)


def value_message(uuid: str, value: Any) -> bytes:
    """Return the message by which a page of viser sets the value of a control."""
    return msgspec.msgpack.encode(ValueMessage(uuid, _Value(value)))


def control_name(message: PageMessage) -> str | None:
    """Return the name of the control or object that a click or a value is for; None for any other message."""
    if isinstance(message, (CameraMessage, UploadPart, _Rendering, _StoredItem)):
        return None
    if isinstance(message, UploadStart):
        return message.source_component_uuid
    return getattr(message, "uuid", getattr(message, "name", ""))


def replaces_earlier(message: PageMessage, control: Any) -> bool:
    """Return True if earlier messages of the same kind are void after this one, such as values of a slider.

    Args:
        message: a message.
        control: the control of a `ValueMessage`, if there is one.
    """
    if isinstance(message, ValueMessage):
        return control is not None and not isinstance(control, (viser.GuiButtonHandle, viser.GuiButtonGroupHandle))
    return isinstance(message, (CurvesMessage, SeekMessage, _ArrowsMove, _ArrowsEnd, _NodeDrag))


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)


def accepted_value(control: Any, value: Any) -> Any:
    """Return the value that a control of viser takes if a page sets it to `value`; numbers are clamped to the bounds.

    Raises:
        ValueError: the value has another type, is not among the options, or the control is disabled.
    """
    fitted = None if control.disabled else _accepted(control, value)
    if fitted is None:
        raise ValueError("its value does not fit the control")
    return fitted


def _accepted(control: Any, value: Any) -> Any:
    if isinstance(control, viser.GuiButtonHandle):
        return True if value is True else None
    if isinstance(control, viser.GuiCheckboxHandle):
        return value if isinstance(value, bool) else None
    if isinstance(control, viser.GuiTextHandle):
        return value if isinstance(value, str) and len(value) <= _TEXT_MAX else None
    if isinstance(control, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        return value if isinstance(value, str) and value in control.options else None
    if isinstance(control, (viser.GuiNumberHandle, viser.GuiSliderHandle)):
        number = _fit_number(value, control.min, control.max)
        return None if number is None or (isinstance(control.value, int) and number != int(number)) else number
    if isinstance(control, (viser.GuiVector2Handle, viser.GuiVector3Handle)):
        return _fit_numbers(value, control.value, control.min, control.max)
    if isinstance(control, (viser.GuiRgbHandle, viser.GuiRgbaHandle)):
        return _fit_numbers(value, control.value, (0,) * 4, (255,) * 4)
    if isinstance(control, viser.GuiMultiSliderHandle):
        size = len(control.value)
        return _fit_numbers(value, control.value, (control.min,) * size, (control.max,) * size)
    return None  # such as the button of an upload


def _fit_number(value: Any, low: float | None, high: float | None) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < NUMBER_MAX:
        return None
    raised = value if low is None else max(value, low)
    return raised if high is None else min(raised, high)


def _fit_numbers(value: Any, current: tuple[float, ...], low: Any, high: Any) -> list[float] | None:
    if not isinstance(value, (list, tuple)) or len(value) != len(current):
        return None
    numbers = [_fit_number(x, low and low[i], high and high[i]) for i, x in enumerate(value)]
    return None if None in numbers else numbers  # type: ignore[return-value]
