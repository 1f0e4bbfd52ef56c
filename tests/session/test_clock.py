import time

import pytest

from aero_viz.session.clock import Clock


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Wall time that the test sets."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_source_time_follows_wall_time_at_the_speed(wall: list[float]):
    clock = Clock(2.0)
    clock.restart(5.0)
    wall[0] += 3.0
    assert clock.now() == pytest.approx(11.0)
    assert clock.delay_until(12.0) == pytest.approx(0.5)
    assert clock.delay_until(1.0) == 0.0


def test_a_change_of_speed_does_not_jump(wall: list[float]):
    clock = Clock()
    wall[0] += 4.0
    clock.speed = 0.25
    assert clock.now() == pytest.approx(4.0)
    wall[0] += 4.0
    assert clock.now() == pytest.approx(5.0)
