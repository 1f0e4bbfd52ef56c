"""ROS 1 and ROS 2 messages, decoded by rosbags."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

ENCODINGS = ("cdr", "ros1")
"""Encodings of messages that can be decoded."""

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Two names of one type."""

_FOXGLOVE_TYPES = {
    "foxglove_msgs/msg/PackedElementField": "string name\nuint32 offset\nuint8 type",
    "foxglove_msgs/msg/PointCloud": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n"
    "uint32 point_stride\nfoxglove_msgs/PackedElementField[] fields\nuint8[] data",
}


class DamagedMessage(ValueError):
    """A message that cannot be decoded. The text completes the sentence "The message cannot be used because ..."."""


def decode_message(data: bytes | memoryview, type_name: str, encoding: str) -> Any:
    """Return a message as an instance of rosbags' dataclass of its type.

    Arrays in the message are views of `data`.

    Args:
        data: the whole message.
        type_name: full name of its type, such as sensor_msgs/msg/PointCloud2.
        encoding: one of `ENCODINGS`.

    Raises:
        DamagedMessage: the bytes are not such a message.
    """
    type_name = TF_TYPES[0] if type_name in TF_TYPES else type_name
    view = memoryview(data)  # rosbags would copy a slice of `bytes`
    try:
        store = _typestore(encoding)
        if encoding == "ros1":
            return store.deserialize_ros1(view, type_name)
        return store.deserialize_cdr(view, type_name)
    except Exception as error:  # the decoders that rosbags generates fail in many ways on damaged bytes
        raise DamagedMessage("its bytes are damaged") from error


def message_type(type_name: str) -> Any:
    """Return rosbags' dataclass of a type of ROS 2."""
    return _typestore("cdr").types[type_name]


def message_definition(type_name: str) -> str | None:
    """Return the definition of a type of ROS 2 with all types in it, None if the type is not known."""
    store = _typestore("cdr")
    return store.generate_msgdef(type_name, ros_version=2)[0] if type_name in store.types else None


def encode_message(message: Any, type_name: str) -> bytes:
    """Return a message of ROS 2 as CDR."""
    return bytes(_typestore("cdr").serialize_cdr(message, type_name))


def ros1_to_cdr(data: bytes, type_name: str) -> bytes:
    """Return a message of ROS 1 as one of ROS 2.

    Raises:
        DamagedMessage: the bytes are not such a message.
    """
    try:
        return bytes(_typestore("cdr").ros1_to_cdr(data, type_name))
    except Exception as error:  # as in decode_message
        raise DamagedMessage("its bytes are damaged") from error


@cache
def _typestore(encoding: str) -> Typestore:
    # All distributions define the types used here alike, so the definitions in the bag are not needed.
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    if encoding == "ros1":
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPES[0]))
    for name, definition in _FOXGLOVE_TYPES.items():
        store.register(get_types_from_msg(definition, name))
    return store
