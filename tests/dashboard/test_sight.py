"""The cut through occluded space at the height of the drone."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_planner.config import Value
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.sight import OccludedSpaceLayer
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Frame, Session
from tests.planner import reference


@pytest.fixture(scope="module")
def frame():
    """The frame of a flight in which the drone is tilted most."""
    session = Session(FlightSource(scene("forest", seed=3)))
    frames = [session.tick() for _ in range(60)]
    session.close()
    return max(frames, key=lambda frame: np.linalg.norm(np.asarray(frame.observation.state.quaternion)[1:3]))


def with_config(frame: Frame, changes: dict[str, Value]) -> Frame:
    return dataclasses.replace(frame, config=frame.config.replace(changes))


def radii(layer: OccludedSpaceLayer, frame: Frame, name: str) -> NDArray[np.float64]:
    """Return the distances from the drone at which each sector of a mesh begins and ends [m], shape [sectors, 2]."""
    changes = {(handle.name.split("/")[-1], key): value for handle, key, value in layer.update(frame)}
    np.testing.assert_array_equal(changes["drone", "position"], frame.observation.state.position)
    corners = np.asarray(changes[name, "vertices"], dtype=np.float64).reshape(-1, 4, 3)
    assert not corners[..., 2].any(), "the cut is horizontal"
    distance = np.linalg.norm(corners, axis=-1)
    np.testing.assert_allclose(distance[:, [0, 1]], distance[:, [3, 2]], atol=1e-5)
    angles = np.arctan2(corners[:, 1, 1], corners[:, 1, 0]) % (2.0 * np.pi)
    np.testing.assert_allclose(angles, 2.0 * np.pi * np.arange(len(corners)) / len(corners), atol=1e-5)
    return distance[:, :2]


def test_the_cut_shows_where_no_stop_may_lie_and_what_is_not_seen(server, frame):
    layer = OccludedSpaceLayer(server)
    occluded, assumed = (radii(layer, frame, name) for name in ("occluded", "assumed"))
    angle = 2.0 * np.pi * (np.arange(len(occluded)) + 0.5) / len(occluded)
    toward = np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=-1)
    body = toward @ reference.rotation(np.asarray(frame.observation.state.quaternion))
    fine, reach = frame.plan.fine_range.astype(np.float64), frame.config.farthest_range
    lowest, highest, _, _ = frame.config.unseen_space.views[0]
    row, column, border = reference.cell_indices(body, *fine.shape)
    is_sure = border > 1e-4  # rounding decides on the cells of the others
    seen = np.maximum(fine[row, column], 0.5)
    np.testing.assert_allclose(occluded[is_sure, 0], seen[is_sure], atol=1e-4)
    np.testing.assert_allclose(occluded[:, 1], reach, atol=1e-4)
    elevation = np.degrees(np.arcsin(reference.cell_centers(*fine.shape)[row, column, 2]))
    is_unseen = (fine[row, column] == reach) & ((elevation < lowest) | (elevation > highest))
    is_unseen |= frame.plan.continued_cells[row, column]
    np.testing.assert_allclose(assumed[is_sure], np.stack((0.5 + 0 * seen, np.where(is_unseen, seen, 0.5)), 1)[is_sure])
    assert 20 < (occluded[:, 0] < reach - 1e-3).sum() < 460 and is_unseen.any()


@pytest.mark.parametrize(("changes", "is_avoided"), [({}, True), ({"stop_proof.prove_stop": False}, False),
                                                     ({"stages.active": "way_out"}, False)])  # fmt: skip
def test_the_legend_says_if_stops_avoid_what_is_occluded(server, frame, changes, is_avoided):
    occluded, assumed = OccludedSpaceLayer(server).legend(with_config(frame, changes))
    assert ("no backup stop" in occluded.label) == is_avoided
    assert (occluded.color, assumed.color) == (palette.OCCLUDED, palette.UNSEEN)


def test_an_update_is_smaller_than_that_of_the_cells(server, frame):
    sent = [value for _, _, value in OccludedSpaceLayer(server).update(frame)]
    assert sum(value.nbytes for value in sent) < 50_000
