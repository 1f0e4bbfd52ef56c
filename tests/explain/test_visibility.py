"""What a cloud tells of lines of sight and surfaces, against rays that are cast in the simulated world."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp
from ensemble_plans import full

from aero_planner import PlannerConfig, Sweeps
from aero_viz.catalog import open_source
from aero_viz.evaluation.world_export import surface_points
from aero_viz.explain.contact import contact, meeting_sentence
from aero_viz.explain.evidence import Replanner
from aero_viz.explain.hidden_points import is_hidden, surface_normal
from aero_viz.explain.verdict import verdict
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
    """Return places on the surfaces of the world within 9 m, and how far beyond the first hit of a ray each lies [m]."""
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
def test_what_the_cloud_says_of_a_line_of_sight_agrees_with_rays(scene: str):
    said = []
    for frame in frames_of(scene)[15::12]:
        eye, cloud = np.asarray(frame.observation.actual_state.position), frame.observation.points
        for place, beyond in zip(*places_around(frame, 60), strict=True):
            hidden = is_hidden(cloud, eye, place)
            said.append(hidden)
            # A line of sight that passes an edge is neither free nor blocked for a cloud with noise.
            if abs(beyond - 0.4) > 0.3 and hidden is not None:
                assert hidden == (beyond > 0.4), (place, beyond)
    assert said.count(None) < 0.5 * len(said)


@pytest.mark.parametrize("scene", ["blocks", "hall"])
def test_normals_of_the_cloud_are_those_of_the_world(scene: str):
    frame = frames_of(scene)[30]
    places, _ = places_around(frame, 150)
    steps, checked = 1e-3 * np.eye(3), 0
    for place in places:
        normal = surface_normal(frame.observation.points, place)
        slope = frame.world.distance(place + steps) - frame.world.distance(place - steps)
        if normal is not None and np.linalg.norm(slope) > 1e-3:
            checked += 1
            assert abs(normal @ slope) / np.linalg.norm(slope) > np.cos(np.radians(20.0)), place
    assert checked > 10
