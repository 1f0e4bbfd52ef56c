import pytest

from aero_planner.config.field_of_view import View, mounted_view


@pytest.mark.parametrize(
    ("roll", "pitch", "view"),
    [
        (0.0, 0.0, (-7.0, 52.0)),
        (1.0, -2.0, (-7.0, 52.0)),
        (180.0, 0.0, (-52.0, 7.0)),
        (-179.0, 1.0, (-52.0, 7.0)),
        (0.0, 180.0, (-52.0, 7.0)),
        (180.0, 180.0, (-7.0, 52.0)),
        (0.0, 20.0, (-90.0, 90.0)),
        (90.0, 0.0, (-90.0, 90.0)),
    ],
)
def test_the_view_turns_with_the_sensor(roll: float, pitch: float, view: tuple[float, float]):
    assert mounted_view(View(-7.0, 52.0), roll=roll, pitch=pitch) == View(*view)


@pytest.mark.parametrize(
    ("angles", "view"),
    [
        ((0.0, 0.0, 0.0), (-20.0, 30.0, 90.0, 10.0)),
        ((0.0, 0.0, 175.0), (-20.0, 30.0, 90.0, -175.0)),
        ((0.0, 40.0, 0.0), (-60.0, -10.0, 90.0, 10.0)),
        ((180.0, 0.0, 0.0), (-30.0, 20.0, 90.0, -10.0)),
        ((90.0, 0.0, 0.0), (-20.0, 20.0, 40.0, 0.0)),
    ],
)
def test_a_narrow_view_moves_with_the_sensor(angles: tuple[float, float, float], view: tuple[float, ...]):
    roll, pitch, yaw = angles
    seen = mounted_view(View(-20.0, 30.0, 90.0, 10.0), roll=roll, pitch=pitch, yaw=yaw)
    assert seen == pytest.approx(view, abs=1.0)
