import pytest

from aero_viz.statistics import METRICS, mean_interval, sign_test, summarise, wilson_interval


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [  # Newcombe 1998, Statistics in Medicine 17, table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_interval(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("wins", "losses", "p_value"),
    [(6, 0, 2 / 2**6), (0, 5, 2 / 2**5), (7, 1, 2 * (1 + 8) / 2**8), (4, 4, 1.0), (0, 0, 1.0)],
)
def test_sign_test(wins, losses, p_value):
    assert sign_test(wins, losses) == pytest.approx(p_value)


def test_wilson_interval_at_the_ends():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(50, 50)[1] == 1.0 and wilson_interval(0, 50)[0] == 0.0
    low, high = wilson_interval(7, 10)
    assert wilson_interval(3, 10) == pytest.approx((1.0 - high, 1.0 - low))
    with pytest.raises(ValueError, match="3 successes of 2"):
        wilson_interval(3, 2)


def record(arrived: bool, speed: float, *, batch: int = 0, reason: str | None = None):
    values = dict.fromkeys(METRICS, 1.0) | {"mean_speed": speed}
    return values | {
        "arrived": arrived,
        "reason": reason or ("arrived" if arrived else "collision"),
        "passable": arrived,
        "plan_ms_median": 2.0 + batch,
        "batch": batch,
        "batch_size": 4,
        "run_s": 8.0,
    }


def test_summary_of_flights():
    flights = [record(True, 4.0), record(True, 6.0), record(False, 90.0), record(False, 90.0, batch=1)]
    line = summarise(flights, row="r", planner="p")
    assert (line.flights, line.arrived, line.success_rate, line.passable) == (4, 2, 0.5, 0.5)
    assert line.mean["mean_speed"] == 5.0 and line.std["mean_speed"] == pytest.approx(2.0**0.5)
    assert line.reasons == {"arrived": 2, "collision": 2}
    assert line.plan_ms_median == 2.5 and line.plan_ms_range == (2.0, 3.0)
    assert summarise(flights[:3], row="r", planner="p").plan_ms_range is None, "of one batch"
    # Three of the four flights of one batch and one of the other: 6 s and 2 s of their 8 s each.
    assert line.flights_per_minute == pytest.approx(60.0 * 4 / 8.0)


def test_summary_without_arrivals_and_of_recorded_flights():
    lost = {**dict.fromkeys(METRICS, 1.0), "arrived": False, "reason": None}
    line = summarise([lost], row="r", planner="p")
    assert line.mean["mean_speed"] is None and line.reasons == {"incomplete": 1}
    assert line.passable is None and line.flights_per_minute is None and line.plan_ms_median is None


def test_the_mean_difference_of_times_has_its_interval():
    # Student's t with 3 degrees of freedom: 3.182 times 1.2910 / 2.
    assert mean_interval([1.0, 2.0, 3.0, 4.0]) == pytest.approx((2.5, 0.4457, 4.5543), abs=1e-3)
    assert mean_interval([1.0]) is None
