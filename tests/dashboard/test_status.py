"""Figures and legend, without a browser."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import pytest
from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels import status
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.session import Session
from aero_viz.session.frame import Frame


@pytest.fixture
def dashboard() -> Iterator[Dashboard]:
    session = Session(small_source(), config=small_config())
    session.tick()
    dashboard = Dashboard(session, port=0)
    yield dashboard
    dashboard.close()
    session.close()


@pytest.fixture
def tell(dashboard: Dashboard) -> Callable[..., str]:
    """Returns what the panel says of the present frame, some of whose fields are others."""
    (panel,) = (panel for panel in dashboard.panels if isinstance(panel, StatusPanel))

    def tell(**fields: object) -> str:
        frame = panel.session.frame
        assert isinstance(frame, Frame)
        ((_, _, content),) = panel.update(dataclasses.replace(frame, **fields))  # type: ignore[arg-type]
        return str(content)

    return tell


def test_a_late_flight_is_reported_as_slow_and_drops_nothing(dashboard, tell, monkeypatch):
    monkeypatch.setattr(status, "_SETTLE_TIME", 0.0)
    session = dashboard._session
    nominal = 1.0 / session.source.period
    assert "slower" not in tell(rate=nominal / 1.8), "nothing is late while time stands still"
    session._set_playing(True)
    assert "1.8 times slower than real time" in tell(rate=nominal / 1.8)
    assert "slower" not in tell(rate=0.95 * nominal)
    session.set_speed(4.0)
    assert "2.0 times slower than requested" in tell(rate=2.0 * nominal)


def test_a_rate_from_before_a_change_of_speed_is_not_reported_as_slow(dashboard, tell, monkeypatch):
    monkeypatch.setattr(status, "_SETTLE_TIME", 1e6)
    session = dashboard._session
    session._set_playing(True)
    session.set_speed(4.0)
    assert "slower" not in tell(rate=1.0 / session.source.period)


def test_dropped_ticks_are_reported(tell):
    assert "dropped" not in tell()
    assert "12 ticks dropped" in tell(dropped_ticks=12)


LEGENDS = [
    ("rollouts", ["chosen rollout", "rank of the Stage II cost"]),
    ("samples", ["rank of the Stage I cost"]),
    ("guides", ["guides</span></div>"]),
    ("anchors", ["initial endpoints", "refined anchors"]),
    ("cloud", ["cloud: height"]),
    ("fine_cells", ["occupied cells"]),
    ("coarse_cells", ["coarse cells", "safe directions"]),
    ("drone", ["drone"]),
    ("trail", ["flown trail"]),
    ("goal", ["goal</span></div>"]),
    ("obstacles", ["obstacles"]),
    ("ground", ["ground grid"]),
]
"""Layers and words of their legends."""


@pytest.mark.parametrize(("layer", "words"), LEGENDS)
def test_the_legend_has_a_key_for_every_layer_that_is_shown(dashboard, tell, layer, words):
    def show(names: list[str]) -> str:
        dashboard.show_only(names)
        dashboard.changes(dashboard._session.frame)
        return tell()

    assert not any(word in show([]) for word in words)
    assert all(word in show([layer]) for word in words)


def test_every_layer_has_a_legend_case(dashboard):
    assert set(dashboard.layers) == {layer for layer, _ in LEGENDS} | {"recorded_path"}


def test_the_legend_names_the_quantity_that_colours_the_rollouts(dashboard, tell):
    dashboard.layers["rollouts"].color_by.value = "log cost"
    assert "log cost of" not in tell() and "rollouts: logarithm of the Stage II cost" in tell()
