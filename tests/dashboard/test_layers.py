"""Changes that layers send, without a browser but with a real server and a real plan."""

import copy
import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig, Sweeps
from aero_planner.plan import MovingObstacles
from aero_planner.quaternions import rotation_matrix
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import LAYERS, apply
from aero_viz.dashboard.layers.base import Lines, polylines
from aero_viz.dashboard.layers.cells import FineCellLayer, UnseenCellLayer, anchor_cells, mean_ranges
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.motion import MotionLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer, cost_scale
from aero_viz.dashboard.layers.scenery import GroundLayer, ObstacleLayer
from aero_viz.dashboard.quadrotor import quadrotor
from aero_viz.flight import FlightSource
from aero_viz.scenes import World, scene
from aero_viz.scenes.obstacles import ObstacleKey, obstacle_at, with_obstacle
from aero_viz.sensors import LidarModel
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for


@pytest.fixture(scope="module")
def frame():
    session = Session(FlightSource(scene("forest", seed=0)))
    session.set_samples(True)
    frames = [session.tick() for _ in range(3)]
    session.close()
    return frames[-1]


def test_rollouts_move_with_the_drone_and_lie_where_they_are_planned(server, frame):
    changes = {(handle.name, name): value for handle, name, value in RolloutLayer(server).update(frame)}
    origin = changes["/rollouts/drone", "position"]
    np.testing.assert_array_equal(origin, frame.observation.actual_state.position)
    path = frame.plan.positions[int(frame.plan.best)]
    drawn = changes["/rollouts/drone/chosen", "points"][: len(path) - 1, 0] + origin
    np.testing.assert_allclose(drawn, path[:-1], atol=1e-5)


def test_a_line_buffer_keeps_its_size_and_collapses_unused_rows_to_the_last_point(server):
    lines = Lines(server.scene, "/test/lines", thickness=1.0, capacity=8)
    segments = np.arange(18, dtype=np.float32).reshape(3, 2, 3)
    apply(lines.show(segments, (200, 100, 50)))
    points = lines.node.points
    assert points.shape == (8, 2, 3)
    np.testing.assert_array_equal(points[:3], segments)
    np.testing.assert_array_equal(points[3:], np.broadcast_to(segments[-1, 1], (5, 2, 3)))
    apply(lines.show(np.zeros((9, 2, 3)), (0, 0, 0)))
    assert lines.node.points.shape == (16, 2, 3)
    apply(lines.show(segments[:1], (0, 0, 0)))
    assert lines.node.points.shape == (16, 2, 3), "a buffer never shrinks"
    apply(lines.show(segments[:0], (0, 0, 0)))
    assert not lines.node.visible


def test_colours_are_sent_when_they_change_and_not_with_every_update(server):
    lines = Lines(server.scene, "/test/colours", thickness=1.0, capacity=8)
    uniform, ramp = np.array((200, 100, 50), np.uint8), np.array([(1, 2, 3), (4, 5, 6)], np.uint8)

    def sent(count: int, colors: np.ndarray) -> bool:
        changes = lines.show(np.zeros((count, 2, 3)), colors)
        apply(changes)
        return "colors" in [name for _, name, _ in changes]

    assert sent(3, uniform)
    assert not sent(5, uniform), "one colour fills the buffer"
    assert sent(9, uniform), "a larger buffer"
    assert (lines.node.colors == uniform).all()
    assert sent(3, ramp) and not sent(3, ramp)
    assert sent(4, ramp), "unused rows have the colour of the last segment's end"
    np.testing.assert_array_equal(lines.node.colors[:4], np.broadcast_to(ramp, (4, 2, 3)))
    assert sent(4, ramp.copy())


def test_polylines_join_neighbours_only():
    vertices = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    segments = polylines(vertices)
    assert segments.shape == (6, 2, 3)
    np.testing.assert_array_equal(segments[2], vertices[0, 2:4])
    np.testing.assert_array_equal(segments[3], vertices[1, 0:2])


def test_the_cloud_is_thinned_evenly_and_sent_once(server, frame):
    cloud = np.random.default_rng(0).normal(size=(150_001, 3)).astype(np.float32)
    cloud[::1000] = np.nan
    layer = CloudLayer(server)
    thick = dataclasses.replace(frame, observation=dataclasses.replace(frame.observation, sweeps=Sweeps([cloud])))
    points = {name: value for _, name, value in layer.update(thick)}["points"]
    assert 10_000 < len(np.unique(points, axis=0)) <= 24_000
    assert len(points) % 4096 == 0
    assert np.isfinite(points).all()
    assert layer.update(frame)
    assert layer.update(frame) == [], "the same cloud is not sent again"
    layer.color_by.value = "range"
    assert layer.update(frame)


def test_the_patches_of_fine_cells_face_the_drone(server, frame):
    changes = {name: value for _, name, value in FineCellLayer(server).update(frame)}
    w, x, y, z = changes["batched_wxyzs"].T
    normals = np.stack((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), axis=1)
    centers = changes["batched_positions"]
    assert len(centers) == frame.plan.fine_range.size
    np.testing.assert_allclose(normals, centers / np.linalg.norm(centers, axis=1, keepdims=True), atol=1e-6)


def test_fine_cells_lie_where_the_filtered_points_are(server, frame):
    changes = {name: value for _, name, value in FineCellLayer(server).update(frame)}
    shown = changes["batched_scales"].max(axis=1) > 0.0
    assert shown.sum() == len(frame.plan.filtered_points)
    reach = np.linalg.norm(changes["batched_positions"][shown], axis=1)
    state = frame.observation.state
    nearest = np.linalg.norm(frame.plan.filtered_points - np.asarray(state.position), axis=1)
    np.testing.assert_allclose(np.sort(reach), np.sort(nearest), atol=1e-3)


def test_continued_cells_have_a_colour_of_their_own_where_the_plan_names_them(server, frame):
    def colors_and_legend(plan: Plan) -> tuple[NDArray[np.uint8], list[str]]:
        layer, shown = FineCellLayer(server), dataclasses.replace(frame, plan=plan)
        changes = {name: value for _, name, value in layer.update(shown)}
        return changes["batched_colors"], [entry.label for entry in layer.legend(shown)]

    continued = frame.plan.continued_cells.ravel()
    assert 100 < continued.sum() < len(frame.plan.filtered_points)
    colors, labels = colors_and_legend(frame.plan)
    unnamed, label = colors_and_legend(dataclasses.replace(frame.plan, continued_cells=None))
    assert (colors[continued] == palette.lit(palette.CONTINUED)).all()
    np.testing.assert_array_equal(colors[~continued], unnamed[~continued])
    np.testing.assert_array_equal(
        unnamed, palette.colorize(frame.plan.fine_range.ravel(), 0.0, 10.0, palette.lit(palette.NEAR_TO_FAR))
    )
    assert [label.split(":")[0] for label in labels] == ["occupied, measured", "occupied, continued"]
    assert label == ["occupied cells, with continued surfaces: range"]


@pytest.mark.parametrize(("view_min", "view_max"), [(-7.0, 52.0), (-90.0, 52.0), (-90.0, 90.0)])
@pytest.mark.parametrize("is_named", [True, False], ids=["continued cells named", "not named"])
def test_unseen_cells_are_continued_or_empty_outside_the_field_of_view(server, frame, view_min, view_max, is_named):
    config = frame.config.replace({"unseen_space.view": f"{view_min:g} {view_max:g}"})
    plan = frame.plan if is_named else dataclasses.replace(frame.plan, continued_cells=None)
    seen, layer = dataclasses.replace(frame, config=config, plan=plan), UnseenCellLayer(server)
    changes = {name: value for _, name, value in layer.update(seen)}
    elevation = np.degrees(np.arcsin(changes["batched_positions"][:, 2] / 2.0))
    is_empty = plan.fine_range.ravel() > config.farthest_range - 1e-4
    empty = is_empty & ((elevation < view_min) | (elevation > view_max))
    continued = plan.continued_cells.ravel() if is_named else np.zeros_like(empty)
    np.testing.assert_array_equal(changes["batched_scales"].max(axis=1) > 0.0, empty | continued)
    assert (changes["batched_colors"][empty] == palette.unmapped(palette.UNSEEN)).all()
    assert (changes["batched_colors"][continued] == palette.unmapped(palette.CONTINUED)).all()
    colors = [palette.UNSEEN] * bool(empty.any()) + [palette.CONTINUED] * bool(continued.any())
    assert [key.color for key in layer.legend(seen)] == colors


def test_unseen_cells_are_free_down_to_ground_of_known_height(server, frame):
    layer = UnseenCellLayer(server)
    unknown = dataclasses.replace(frame, observation=dataclasses.replace(frame.observation, ground_height=None))
    ignored = dataclasses.replace(frame, config=frame.config.replace({"costs.use_ground": False}))
    assert frame.observation.ground_height == 0.0
    assert [layer.legend(each)[0].label.endswith("above the ground") for each in (frame, unknown, ignored)] == [
        True, False, False,
    ]  # fmt: skip


@pytest.mark.parametrize("by", ["rank", "log cost"])
def test_cost_scale_runs_from_the_worst_to_the_best(frame, by):
    scale = cost_scale(frame.plan, by=by)
    cost = np.asarray(frame.plan.stage2_cost)
    assert scale[cost.argmin()] == 1.0
    assert scale[cost.argmax()] == 0.0
    assert (np.diff(scale[np.argsort(cost)]) <= 0.0).all()


@pytest.mark.parametrize("kind", LAYERS.values(), ids=list(LAYERS))
def test_a_layer_follows_a_change_of_structure(server, kind):
    layer = kind(server)
    session = Session(FlightSource(scene("forest", seed=0)))
    apply(layer.on_new_source(session.source))
    session.set_samples(True)
    try:
        apply(layer.update(session.tick()))
        session.configure({"anchors.columns": 7, "sampling.steps": 12, "partition.fine_cells": 4})
        apply(layer.update(session.tick()))
        session.configure(PlannerConfig.preset("paper"))
        apply(layer.update(session.tick()))
    finally:
        session.close()


def test_cells_are_told_apart_and_those_of_anchors_are_known(frame):
    means = mean_ranges(frame.plan)
    assert means.shape == frame.plan.safe_range.shape
    assert len(np.unique(np.round(means, 2))) > len(np.unique(np.round(frame.plan.safe_range, 2)))
    assert (means <= frame.plan.safe_range + 1e-4).all()
    cells = anchor_cells(frame)
    assert 1 <= len(cells) <= frame.config.anchor_count
    # A refined anchor lies in the safe direction of the cell of its initial endpoint.
    state = frame.observation.state
    toward = frame.plan.anchors[: frame.config.anchor_count] - np.asarray(state.position)
    toward = (toward / np.linalg.norm(toward, axis=1, keepdims=True)) @ rotation_matrix(state.quaternion)
    safe = frame.plan.safe_direction.reshape(-1, 3)[cells]
    assert (toward @ safe.T).max(axis=1) == pytest.approx(1.0, abs=1e-3)


def solid(**tables: NDArray[np.float64]) -> FlightSource:
    """A flight 2 m below the origin toward the given solids."""
    world = World("solid", np.array([0.0, 0.0, -2.0]), np.array([12.0, 0.0, -2.0]), mission=None, **tables)
    return FlightSource(world, lidar=LidarModel("sparse", points_per_sweep=2000))


SOLIDS = {
    "cylinders": np.array([[5.0, 0.0, -4.0, 0.0, 0.0, 1.0, 0.3, 4.0]]),
    "boxes": np.array([[5.0, 0.0, -2.0, 1.0, 1.0, 1.0, 0.0]]),
    "spheres": np.array([[5.0, 0.0, -2.0, 0.5]]),
    "triangles": np.array([[5.0, -3.0, -4.0, 5.0, 3.0, -4.0, 5.0, 0.0, 1.0]]),
}


def test_solids_of_every_kind_are_drawn_while_the_world_has_them(server):
    layer = ObstacleLayer(server)
    nodes = {**layer.solids, "triangles": layer.triangles}

    def drawn(source: FlightSource) -> set[str]:
        apply(layer.on_new_source(source.info))
        assert layer.available
        return {kind for kind, node in nodes.items() if node.visible}

    assert drawn(solid(**SOLIDS)) == SOLIDS.keys()
    assert drawn(solid(spheres=SOLIDS["spheres"])) == {"spheres"}
    np.testing.assert_array_equal(layer.solids["spheres"].batched_positions, SOLIDS["spheres"][:, :3])
    assert drawn(solid(triangles=SOLIDS["triangles"])) == {"triangles"}
    np.testing.assert_array_equal(layer.triangles.vertices.ravel(), SOLIDS["triangles"].ravel())
    assert layer.triangles.side == "double", "a mesh's triangles may face any way"


@pytest.mark.parametrize("kind", SOLIDS)
def test_an_obstacle_is_faint_while_it_is_between_a_camera_and_the_drone(server, kind):
    layer = ObstacleLayer(server)
    session = Session(solid(**{kind: SOLIDS[kind]}))
    frame = session.tick()
    session.close()
    apply(layer.on_new_source(frame.source))
    for eye, is_faint in (((9.0, 0.0, -2.0), True), ((-4.0, 0.0, -2.0), False), ((5.0, 0.0, -2.0), True)):
        layer.eyes = [np.array(eye)]
        apply(layer.update(frame))
        assert layer.faint.visible == is_faint
        left = np.any(layer.triangles.faces if kind == "triangles" else layer.solids[kind].batched_scales)
        assert left != is_faint
    layer.eyes = [np.array((-4.0, 0.0, -2.0)), np.array((9.0, 0.0, -2.0))]
    apply(layer.update(frame))
    assert layer.faint.visible, "one of two visitors would not see the drone"


def test_a_thrown_or_moving_obstacle_is_never_faint(server):
    layer, eye = ObstacleLayer(server), np.array((9.0, 0.0, -2.0))
    session = Session(solid(cylinders=SOLIDS["cylinders"]))
    frame = session.tick()
    session.close()
    world = frame.world
    assert world is not None
    thrown = with_obstacle(world, obstacle_at(world, ObstacleKey("cylinders", 0)))
    moving = dataclasses.replace(world, motion=np.array([[0.0, 0.1, 1.0]]))
    for shown, faint in ((world, [0]), (thrown, [0]), (moving, [])):
        observation = dataclasses.replace(frame.observation, world=shown)
        layer.eyes = [eye]
        apply(layer.update(dataclasses.replace(frame, observation=observation)))
        assert layer.faint_obstacles == [ObstacleKey("cylinders", row) for row in faint]


def test_points_between_a_camera_and_the_drone_are_left_out(server, frame):
    layer = CloudLayer(server)
    place = np.asarray(frame.observation.state.position)
    eye = np.add(place, (-5.0, 0.0, 2.0))
    hiding = np.linspace(eye, place, 50, dtype=np.float32)[5:-10]
    behind = np.add(place, (3.0, 4.0, 0.0)).astype(np.float32)[None]
    cloud = np.concatenate((hiding, behind))
    shown = dataclasses.replace(frame, observation=dataclasses.replace(frame.observation, sweeps=Sweeps([cloud])))
    layer.eyes = [eye]
    changes = {name: value for _, name, value in layer.update(shown)}
    np.testing.assert_array_equal(np.unique(changes["points"], axis=0), behind)


@pytest.mark.parametrize(
    ("tables", "low", "high"),
    [
        ({"boxes": np.array([[5.0, 0.0, -10.5, 60.0, 60.0, 1.0, 0.0]])}, -10.0, -10.0),
        ({"triangles": SOLIDS["triangles"]}, -3.5, -2.0),
    ],
    ids=["flat ground", "no ground"],
)
def test_the_grid_lies_on_flat_ground_or_below_the_points(server, tables, low, high):
    layer = GroundLayer(server)
    session = Session(solid(**tables))
    layer.on_new_source(session.source)
    [(_, name, place)] = layer.update(session.tick())
    session.close()
    assert name == "position"
    assert low <= place[2] <= high


def test_the_quadrotor_fits_its_rotors():
    vertices = np.concatenate([mesh.vertices for mesh, _, _ in quadrotor().values()])
    assert np.linalg.norm(vertices[:, :2], axis=1).max() == pytest.approx(0.25, abs=0.005)
    for mesh, _, _ in quadrotor().values():
        assert mesh.faces.min() >= 0
        assert mesh.faces.max() < len(mesh.vertices)


def test_a_layer_that_is_hidden_while_a_visitor_connects_is_hidden_from_this_visitor(server):
    layer = GroundLayer(server)
    with join(server) as connection:
        send(connection, **CAMERA)
        wait_for(server.get_clients, "the visitor")
        (visitor,) = server.get_clients().values()

        def add_frame(*arguments: Any, **options: Any) -> Any:
            frame = visitor.scene.add_frame(*arguments, **options)
            layer.visible = False
            return frame

        layer.welcome(
            cast(Any, SimpleNamespace(client_id=visitor.client_id, scene=SimpleNamespace(add_frame=add_frame)))
        )
        assert not layer.is_visible_to(visitor.client_id)


def test_dynamic_obstacles_are_ringed_now_and_at_the_end_of_the_plan(server, frame):
    layer, node = MotionLayer(server), "/motion/lines"
    still = dataclasses.replace(frame, plan=with_moving(frame.plan, np.zeros((0, 5))))
    assert [value for _, name, value in layer.update(still) if name == "visible"] == [False] and not layer.legend(still)
    moved = dataclasses.replace(frame, plan=with_moving(frame.plan, np.array([[5.0, 1.0, 0.0, -2.0, 0.4]])))
    (points,) = (value for handle, name, value in layer.update(moved) if name == "points" and handle.name == node)
    height = frame.observation.actual_state.position[2]
    np.testing.assert_allclose(points[..., 2], height, rtol=1e-6)
    end = np.array([5.0, 1.0 - 2.0 * frame.config.horizon])
    radius = 0.4 + 0.1 * frame.config.horizon
    for center, expected, ring in (((5.0, 1.0), 0.4, points[:32]), (end, radius, points[32:64])):
        np.testing.assert_allclose(np.linalg.norm(ring[..., :2] - center, axis=-1), expected, rtol=1e-5)
    np.testing.assert_allclose(points[64, :, :2], np.array([[5.0, 1.0], end]), rtol=1e-6)
    assert [key.color for key in layer.legend(moved)] == [palette.MOVING]


def with_moving(plan: Plan, rows: NDArray[np.float64]) -> Plan:
    """Return a plan in which obstacles move: rows of position [m], velocity [m/s] and radius [m], shape [n, 5]."""
    changed, values = copy.copy(plan), rows.astype(np.float32)
    changed.__dict__["moving"] = MovingObstacles(values[:, :2], values[:, 2:4], values[:, 4])
    return changed
