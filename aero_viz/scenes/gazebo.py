"""Gazebo worlds: SDF files of cylinders, boxes and spheres.

XML can define entities that expand to gigabytes or name other files. Such a definition is refused, and no file that a
world names is opened.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import read_user_bytes
from aero_viz.input_limits import SDF_DEPTH_MAX, SDF_SOLIDS_MAX, TEXT_MAX
from aero_viz.scenes.decoder_checks import refuse_entities
from aero_viz.scenes.solids import Pose, Solids

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

Table = NDArray[np.float64]

_GROUND_SIZE = 100.0
"""Edge of the ground of model://ground_plane [m], and of a plane without a size."""
_GROUND_THICKNESS = 1.0


def read_gazebo(path: Path) -> Solids:
    """Return the solids of all models in a world or model.

    As in Gazebo, the state of the world, where there is one, gives the pose of a model and scales its shapes. The
    collision geometry of a link counts, or the visual one where there is none. A level plane becomes the ground.
    Meshes, height maps, and models that are included from elsewhere are counted as left out.

    Raises:
        ValueError: the file is not SDF, or a value is missing or malformed; the text names the model.
    """
    root = _parse(path)
    if root.tag != "sdf":
        raise ValueError(f"its outermost element is <{root.tag[:40]}>, not <sdf>")
    solids = Solids()
    for world in root.findall("world") or [root]:
        moved = {model.get("name"): model for state in world.findall("state") for model in state.findall("model")}
        for model in world.findall("model"):
            _add_model(model, moved.get(model.get("name")), Pose.from_values([0.0] * 6), solids)
        for include in world.iter("include"):
            if (include.findtext("uri") or "").strip() == "model://ground_plane":
                _add_plane(_pose(include), np.full(2, _GROUND_SIZE), solids)
            elif (include.findtext("uri") or "").strip() != "model://sun":
                _leave_out("included model", solids)
    return solids


def _parse(path: Path) -> Element:
    from xml.etree.ElementTree import TreeBuilder

    if path.stat().st_size > TEXT_MAX:
        raise ValueError(f"it has {path.stat().st_size / 2**20:.0f} MiB, and at most {TEXT_MAX >> 20} MiB are read")
    builder, parser, depth = TreeBuilder(), expat.ParserCreate(), 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > SDF_DEPTH_MAX:
            raise ValueError(f"its elements are nested more than {SDF_DEPTH_MAX} deep")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    refuse_entities(parser)
    try:
        parser.Parse(read_user_bytes(path, limit=TEXT_MAX), True)
    except expat.ExpatError as error:
        raise ValueError(f"it is not XML: {expat.ErrorString(error.code)} in line {error.lineno}") from error
    return builder.close()


def _add_model(model: Element, state: Element | None, frame: Pose, solids: Solids) -> None:
    try:
        placed = model if state is None or state.find("pose") is None else state
        pose = frame @ _pose(placed)
        scale = np.ones(3) if state is None or state.find("scale") is None else _numbers(state, "scale", 3)
        states = {} if state is None else {child.get("name"): child for child in state.findall("model")}
        for link in model.findall("link"):
            _add_link(link, pose @ _pose(link), scale, solids)
    except ValueError as error:
        raise ValueError(f"the model {(model.get('name') or '')[:60]!r}: {error}") from error
    for child in model.findall("model"):
        # The state of a nested model is in the frame of the world.
        known = states.get(child.get("name"))
        _add_model(child, known, pose if known is None else Pose.from_values([0.0] * 6), solids)


def _add_link(link: Element, frame: Pose, scale: Table, solids: Solids) -> None:
    for part in link.findall("collision") or link.findall("visual"):
        geometry = part.find("geometry")
        shapes = [] if geometry is None else list(geometry)
        for shape in shapes:
            _add_shape(shape, frame @ _pose(part), scale, solids)


def _add_shape(shape: Element, pose: Pose, scale: Table, solids: Solids) -> None:
    if sum(map(len, (solids.cylinders, solids.boxes, solids.spheres, solids.triangles))) >= SDF_SOLIDS_MAX:
        raise ValueError(f"the file has more than {SDF_SOLIDS_MAX} solids; split it")
    if shape.tag == "cylinder":
        radius = _numbers(shape, "radius", 1)[0] * scale[:2].max()
        length = _numbers(shape, "length", 1)[0] * scale[2]
        axis = pose.rotation[:, 2]
        solids.cylinders.append(np.array([*(pose.position - 0.5 * length * axis), *axis, radius, length]))
    elif shape.tag == "box":
        solids.add_box(pose, _numbers(shape, "size", 3) * scale)
    elif shape.tag == "sphere":
        solids.spheres.append(np.array([*pose.position, *(_numbers(shape, "radius", 1) * scale.max())]))
    elif shape.tag == "plane" and pose.is_level:
        size = shape.find("size")
        _add_plane(pose, np.full(2, _GROUND_SIZE) if size is None else _numbers(shape, "size", 2), solids)
    elif shape.tag != "empty":
        _leave_out(shape.tag[:40], solids)


def _add_plane(pose: Pose, size: Table, solids: Solids) -> None:
    yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    x, y, z = pose.position
    row = np.array([x, y, z - 0.5 * _GROUND_THICKNESS, *size, _GROUND_THICKNESS, yaw])
    if solids.ground is None:
        solids.ground = row
    else:
        solids.boxes.append(row)


def _leave_out(kind: str, solids: Solids) -> None:
    solids.left_out[kind] = solids.left_out.get(kind, 0) + 1


def _pose(element: Element) -> Pose:
    pose = element.find("pose")
    if pose is None:
        return Pose.from_values([0.0] * 6)
    relative = pose.get("frame") or pose.get("relative_to")
    if relative:
        raise ValueError(f"its pose is relative to {relative[:60]!r}; write poses in the frame of the parent")
    values = _split(pose.text, "pose", 6)
    if pose.get("degrees") in ("true", "1"):
        values[3:] = np.radians(values[3:])
    return Pose.from_values(values.tolist())


def _numbers(element: Element, name: str, count: int) -> Table:
    return _split(element.findtext(name), f"{name} of its {element.tag}", count)


def _split(text: str | None, name: str, count: int) -> Table:
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"the {name} is {' '.join((text or '').split())[:60]!r}; it must have {count} finite numbers")
    return values
