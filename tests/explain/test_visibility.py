"""What a cloud tells of lines of sight and surfaces, against rays that are cast in the simulated world."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp

from aero_planner import PlannerConfig, Sweeps
from aero_viz.catalog import open_source
from aero_viz.evaluation.world_export import surface_points
from aero_viz.explain.contact import contact, meeting_sentence
from aero_viz.explain.hidden_points import hides, surface_normal
from aero_viz.explain.visibility import find_seen, sight_of
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.raycast import cast
from aero_viz.session import Frame, Session


@functools.cache
def frames_of(scene: str) -> tuple[Frame, ...]:
    session = Session(open_source(scene, seed=907), config=PlannerConfig())
    frames = [session.tick() for _ in range(40)]
    session.close()
    return tuple(frames)


def places_around(frame: Frame, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places on the surfaces of the world within 9 m, and how far behind the first hit of a ray they lie [m]."""
    assert frame.world is not None
    eye = np.asarray(frame.observation.actual_state.position)
    points = surface_points(frame.world, spacing=0.3)
    points = points[np.linalg.norm(points - eye, axis=1) < 9.0]
    places = np.random.default_rng(1).choice(points, min(count, len(points)), replace=False)
    distance = np.linalg.norm(places - eye, axis=1)
    with wp.ScopedDevice("cpu"):
        origins = wp.array(eye[None], dtype=wp.vec3)
        rays = wp.array(((places - eye) / distance[:, None])[None], dtype=wp.vec3)
        hits = np.asarray(cast(DeviceWorlds([frame.world]), origins, rays).numpy())[0]
    return places, distance - hits


@pytest.mark.parametrize("scene", ["forest", "blocks", "hall"])
def test_what_the_cloud_hides_is_hidden_from_rays(scene: str):
    said, covered = 0, 0
    for frame in frames_of(scene)[15::12]:
        eye, cloud = np.asarray(frame.observation.actual_state.position), frame.observation.points
        for place, beyond in zip(*places_around(frame, 80), strict=True):
            is_said, is_covered = hides(cloud, eye, place), beyond > 1.5 and points_before(cloud, eye, place, 1.0) > 2
            assert beyond > 0.1 or not is_said, (place, beyond)
            covered += is_covered
            said += is_said and is_covered
    assert covered and said > 0.9 * covered


def points_before(cloud: np.ndarray, eye: np.ndarray, place: np.ndarray, gap: float) -> int:
    """Count the points of a cloud that stand before a place, `gap` metres at least, within 0.3 deg of the sight."""
    offset, sight = cloud - eye, (place - eye) / np.linalg.norm(place - eye)
    length = np.linalg.norm(offset, axis=1)
    is_before = (length > 0.1) & (length < np.linalg.norm(place - eye) - gap)
    return int((offset[is_before] @ sight > np.cos(np.radians(0.3)) * length[is_before]).sum())


def test_a_flight_without_a_world_is_told_only_what_its_cloud_shows():
    """The same ticks, with the world and without: what is said without it is true in it."""
    frames = [dataclasses.replace(frame) for frame in frames_of("blocks")[20:26]]
    blind = [without_world(frame) for frame in frames]
    told = 0
    for place in places_around(frames[-1], 40)[0]:
        with_world, without = find_seen(frames, place), find_seen(blind, place)
        assert without.since_s == with_world.since_s
        if without.reason == "occluded":
            told += 1
            assert with_world.reason == "occluded" and "what the cloud shows before it" in without.detail
        assert without.reason != "no ray hit it", "whether something hid it is not known"
    assert told


def without_world(frame: Frame) -> Frame:
    observation = dataclasses.replace(frame.observation, world=None)
    return dataclasses.replace(frame, source=dataclasses.replace(frame.source, world=None), observation=observation)


@pytest.mark.parametrize("scene", ["blocks", "hall"])
def test_normals_of_the_cloud_are_those_of_the_world(scene: str):
    frame = frames_of(scene)[30]
    places, _ = places_around(frame, 150)
    steps, checked = 1e-3 * np.eye(3), 0
    assert frame.world is not None
    for place in places:
        normal = surface_normal(frame.observation.points, place)
        slope = frame.world.distance(place + steps) - frame.world.distance(place - steps)
        if normal is not None and np.linalg.norm(slope) > 1e-3:
            checked += 1
            assert abs(normal @ slope) / np.linalg.norm(slope) > np.cos(np.radians(20.0)), place
    assert checked > 10


WALLS = World.from_dict(
    {"name": "t", "start": [0, 0, 2], "goal": [9, 0, 2],
     "boxes": [[0, 0, -0.5, 80, 80, 1, 0], [3, 0, 2, 0.2, 3, 4, 0], [8, 0, 2, 0.2, 20, 4, 0]]}
)  # fmt: skip


def test_what_is_remembered_but_out_of_sight_is_said():
    session = Session(open_source("forest", seed=3))
    frame = session.tick()
    session.close()
    at_start = dataclasses.replace(
        frame, source=dataclasses.replace(frame.source, world=WALLS), observation=moved(frame, [0.0, 0.0, 2.0])
    )
    behind, above, aside = np.array([7.9, 0.0, 2.0]), np.array([1.0, 0.0, 9.0]), np.array([7.9, 6.0, 2.0])
    assert sight_of(at_start, behind) == "occluded by box 1"
    assert sight_of(at_start, above) == "outside the field of view"
    assert sight_of(at_start, aside) == ""
    remembered = dataclasses.replace(at_start.observation, sweeps=Sweeps([np.array([behind], np.float32)]))
    seen = find_seen([dataclasses.replace(at_start, observation=remembered)], behind)
    assert seen.from_start and seen.in_sight_s is None and seen.last_sight == "occluded by box 1"


def moved(frame: Frame, position: list[float]):
    state = dataclasses.replace(frame.observation.actual_state, position=np.array(position))
    return dataclasses.replace(frame.observation, state=state, true_state=state, world=WALLS)


@pytest.mark.parametrize(
    ("velocity", "words"),
    [([4.0, 0.0, 0.0], "head-on at 4.0 m/s, 0 deg"), ([1.0, 3.0, 0.0], "at a grazing angle at 3.2 m/s, 72 deg")],
)
def test_how_a_drone_meets_a_wall_is_told(velocity: list[float], words: str):
    frame = dataclasses.replace(frames_of("forest")[0])
    place, name, normal = contact(frame, WALLS, np.array([2.7, 0.3, 2.0]))
    assert name == "box 1" and place == pytest.approx([2.9, 0.3, 2.0], abs=1e-2)
    assert words in meeting_sentence(normal, np.array(velocity))[0]
    assert not meeting_sentence(normal, np.zeros(3)) and not meeting_sentence(None, np.array(velocity))
