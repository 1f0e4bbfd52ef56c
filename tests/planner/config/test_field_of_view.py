import pytest

from aero_planner.config import PlannerConfig
from aero_planner.config.field_of_view import View, format_views, mounted_view


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
        ((0.0, 150.0, 0.0), (-90.0, -89.0, 90.0, 10.0)),
    ],
)
def test_a_narrow_view_moves_with_the_sensor(angles: tuple[float, float, float], view: tuple[float, ...]):
    roll, pitch, yaw = angles
    seen = mounted_view(View(-20.0, 30.0, 90.0, 10.0), roll=roll, pitch=pitch, yaw=yaw)
    assert seen == pytest.approx(view, abs=1.0)
    assert PlannerConfig().replace({"unseen_space.view": format_views((seen,))}).unseen_space.views[0] == pytest.approx(
        seen, abs=1e-3
    )


@pytest.mark.parametrize(
    ("text", "views"),
    [
        ("-7 52", (View(-7.0, 52.0),)),
        ("-29 29 87", (View(-29.0, 29.0, 87.0),)),
        ("-7 52; -29.5 29 87 -90", (View(-7.0, 52.0), View(-29.5, 29.0, 87.0, -90.0))),
    ],
)
def test_views_are_a_text(text: str, views: tuple[View, ...]):
    assert PlannerConfig().replace({"unseen_space.view": text}).unseen_space.views == views
    assert format_views(views) == text


@pytest.mark.parametrize("text", ["-7", "5 3", "-7 52 400", "-7 52 0", "-100 0", "up down", "1 2; 3 4; 5 6", "-7 52;"])
def test_a_wrong_view_is_quoted(text: str):
    with pytest.raises(ValueError, match=r"unseen_space.view (is|has) '") as caught:
        PlannerConfig().replace({"unseen_space.view": text})
    assert text in str(caught.value)
