import dataclasses
from pathlib import Path

import bags
import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.score import Trajectory, load_trajectory, other_world, score
from aero_viz.flight import FlightResult, FlightRules, fly
from aero_viz.logs import flight_recorder
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel

LIDAR = LidarModel("small", points_per_sweep=1000)
CONFIG = PlannerConfig.preset("fast-cpu")
OPEN = World("open", np.array([0.0, 0.0, 2.0]), np.array([4.0, 0.0, 2.0]), spheres=np.array([[2.0, 2.5, 2.0, 0.5]]))
COMPARED = [f.name for f in dataclasses.fields(FlightResult) if f.name not in ("plan_ms_median", "seed", "config")]


def assert_same(scored: FlightResult, flown: FlightResult) -> None:
    for name in COMPARED:
        expected = getattr(flown, name)
        relative = 1e-4 if isinstance(expected, float) else None
        assert getattr(scored, name) == (pytest.approx(expected, rel=relative) if relative else expected), name


@pytest.mark.parametrize(
    ("world", "speed", "reason"),
    [
        (OPEN, 2.0, "arrived"),
        (scene("forest", seed=3, count=60), 7.0, None),  # flown for less than a second
        (dataclasses.replace(scene("forest", seed=3, count=4), bounds=np.array([[-9, -9, 1.99], [50, 9, 9.0]])), 7.0,
         "out_of_bounds"),
    ],
    ids=["arrived", "timeout", "out of bounds"],
)  # fmt: skip
def test_a_simulated_flight_scores_as_it_was_flown(world, speed, reason, tmp_path):
    rules = FlightRules(time_limit=60.0 if reason else 0.9)
    flown = fly(world, config=CONFIG, seed=4, lidar=LIDAR, speed=speed, rules=rules, trajectory=tmp_path / "flight.csv")
    assert flown.reason == (reason or "timeout")
    scored = score(load_trajectory(tmp_path / "flight.csv"), world, rules=rules, seed=4)
    assert_same(scored, flown)
    assert scored.seed == flown.seed


def test_a_flight_log_scores_as_it_was_flown(tmp_path):
    world = OPEN
    flown = fly(
        world, recorder=flight_recorder(tmp_path / "flight.mcap"), config=CONFIG, seed=4, lidar=LIDAR, speed=2.0
    )
    trajectory = load_trajectory(tmp_path / "flight.mcap")
    assert_same(score(trajectory, world), flown)
    assert_same(score(load_trajectory(tmp_path / "flight.mcap", pose_topic="/odometry"), world), flown)
    with pytest.raises(UserError, match="no poses on /nowhere; topics with poses: /odometry"):
        load_trajectory(tmp_path / "flight.mcap", pose_topic="/nowhere")


def straight(*, rate: float = 50.0, speed: float = 2.0, until: float = 10.0, measured: bool = True) -> Trajectory:
    times = np.arange(0.0, until + 1e-9, 1.0 / rate)
    positions = np.column_stack([speed * times, np.zeros_like(times), np.zeros_like(times)])
    velocities = np.tile([speed, 0.0, 0.0], (len(times), 1)) if measured else None
    return Trajectory("straight", 100.0 + times, positions, velocities)


GOAL = np.array([10.0, 0.0, 0.0])
EMPTY = World("empty", np.zeros(3), GOAL)
BALL = World("ball", np.zeros(3), GOAL, spheres=np.array([[4.0, 1.0, 0.0, 0.5]]))


@pytest.mark.parametrize("rate", [50.0, 7.3, 400.0])
@pytest.mark.parametrize("measured", [True, False])
def test_known_numbers_at_any_rate(rate, measured):
    result = score(straight(rate=rate, measured=measured), BALL)
    assert result.arrived and result.reason == "arrived"
    assert result.flight_time_s == pytest.approx(4.5, abs=0.021)  # 1 m before the goal
    assert result.length_m == pytest.approx(2.0 * result.flight_time_s)
    assert (result.mean_speed, result.max_speed) == pytest.approx((2.0, 2.0))
    assert result.min_clearance == pytest.approx(0.5)
    assert result.smoothness == pytest.approx(0.0, abs=1e-9)  # it starts at speed: no acceleration at all


def test_smoothness_of_a_constant_acceleration():
    times = np.arange(0.0, 2.0, 0.02)
    zero = np.zeros_like(times)
    motion = Trajectory(
        "pull", times, np.column_stack([1.5 * times**2, zero, zero]), np.column_stack([3.0 * times, zero, zero])
    )
    # One jump of the acceleration from 0 to 3 m/s^2: |3|^2 / dt.
    assert score(motion, EMPTY).smoothness == pytest.approx(9.0 / 0.02)


@pytest.mark.parametrize(
    ("trajectory", "world", "rules", "reason", "time"),
    [
        (straight(), dataclasses.replace(BALL, spheres=np.array([[4.0, 0.5, 0.0, 0.5]])), FlightRules(), "collision",
         1.74),
        (straight(), BALL, FlightRules(radius=0.6), "collision", 1.78),
        (straight(), BALL, FlightRules(time_limit=2.0), "timeout", 2.0),
        (straight(until=3.0), BALL, FlightRules(), None, 3.0),
        (straight(speed=0.1), BALL, FlightRules(), "stall", 5.0),
        (straight(), dataclasses.replace(EMPTY, bounds=np.array([[-1, -1, -1], [3.01, 1, 1]])), FlightRules(),
         "out_of_bounds", 1.52),
        (straight(), dataclasses.replace(EMPTY, spheres=np.array([[0.0, 0.0, 0.0, 0.5]])), FlightRules(), "collision",
         0.0),
    ],
)  # fmt: skip
def test_the_reason_and_time_of_the_end(trajectory, world, rules, reason, time):
    result = score(trajectory, world, rules=rules)
    assert (result.reason, result.arrived) == (reason, False)
    assert result.flight_time_s == pytest.approx(time, abs=0.021)


def test_clearance_between_samples_counts():
    pillar = World("thin", np.zeros(3), GOAL, spheres=np.array([[4.05, 0.0, 0.0, 0.01]]))
    assert score(straight(rate=5.0), pillar).reason == "collision"


def test_empty_world_has_no_clearance():
    result = score(straight(), EMPTY)
    assert result.mean_clearance is None and result.min_clearance is None


def test_csv_columns_are_found_by_name(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("yaw, x,y,z, T\n" + "".join(f"9,{0.1 * i},0,2,{0.02 * i}\n" for i in range(50)), encoding="utf-8")
    trajectory = load_trajectory(file)
    assert trajectory.velocities is None and trajectory.positions[10].tolist() == [1.0, 0.0, 2.0]
    assert trajectory.at(np.array([0.123]))[1][0] == pytest.approx([5.0, 0.0, 0.0])


@pytest.mark.parametrize(("name", "ros1"), [("flight.bag", True), ("flight", False)])
def test_bags_of_ros_1_and_ros_2_score_like_the_trajectory_in_them(tmp_path, name, ros1):
    flown = straight(rate=20.0)
    assert flown.velocities is not None
    # The drone is level and faces forward, so that the twist is the velocity.
    samples = zip(flown.times, flown.positions, flown.velocities, strict=True)
    messages = [bags.odometry(time, position, twist=velocity) for time, position, velocity in samples]
    path = bags.write_ros1(tmp_path / name, messages) if ros1 else bags.write_ros2(tmp_path / name, messages, "sqlite3")
    loaded = load_trajectory(path)
    expected, found = score(flown, BALL), score(loaded, BALL)
    for field in COMPARED:
        value = getattr(expected, field)
        assert getattr(found, field) == (
            pytest.approx(value, rel=1e-5, abs=1e-6) if isinstance(value, float) else value
        )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the column 't' in line 1"),
        ("t,x,y\n0,0,0\n", "lacks the column 'z' in line 1"),
        ("t,x,y,z\n", "holds no samples"),
        ("t,x,y,z\n0,0,0,0\n0.1,a,0,0\n", "line 3: '0.1,a,0,0' does not hold 4 numbers"),
        ("t,x,y,z\n0,0,0,0\n0.1,0\n", "line 3"),
        ("t,x,y,z\n0,0,0,0\n\n0.1,1,inf,0\n", "line 4: y is inf; it must be a finite number"),
        ("t,x,y,z\n0,0,0,0\n\n0.1,1,0,0\n\n0.1,1,0,0\n", "line 6: t does not increase"),
        ("t,x,y,z,vx,vy,vz\n0,0,0,0,1,0,0\n0.1,0,0,0,1,0\n", "line 3: '0.1,0,0,0,1,0' does not hold 7 numbers"),
        ("t,x,y,z\n0,0,0,0\n0.1,1e300,0,0\n", "line 3: x is 1e+300; it must be a finite number"),
        ("t;x;y;z\n0;0;0;0\n", "lacks the column 't' in line 1"),
        ("t,x,y,z\n" + "x," * 40_000, "line 2: '[...]' does not hold 4 numbers"),
        ("t,x,y,z\n" + "".join(f"{0.1 * i + 3 * (i > 9)},0,0,0\n" for i in range(20)), "between 0.90 s and 4.00 s"),
        ("t,x,y,z\n0,0,0,0\n0.1,nan,0,0\n", "line 3: x is nan; it must be a finite number"),
        ("t,x,y,z\n0,0,0,0\n0,0,0,0\n", "line 3: t does not increase"),
        ("t,x,y,z\n0,0,0,0\n", "too few to score"),
        ("t,x,y,z\n0,0,0,0\n1,1,0,0\n2,2,0,0\n", "record at least one every 0.25 s"),
    ],
)
def test_csv_that_is_not_a_trajectory_is_refused(text, message, tmp_path):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(UserError) as caught:
        load_trajectory(tmp_path / "a.csv")
    assert message in str(caught.value)


def test_recordings_without_poses(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "empty.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(UserError, match="no topic with poses; topics with poses: none"):
        load_trajectory(tmp_path / "empty.mcap")
    with pytest.raises(UserError, match="does not exist"):
        load_trajectory(Path("/nowhere/flight.mcap"))


def test_the_log_of_another_world_is_noticed(tmp_path: Path):
    rules = FlightRules(time_limit=0.1)
    fly(OPEN, config=CONFIG, lidar=LIDAR, rules=rules, recorder=flight_recorder(tmp_path / "flight.mcap"))
    assert other_world(tmp_path / "flight.mcap", OPEN) is None
    moved = dataclasses.replace(OPEN, goal=OPEN.goal + 1.0, name="elsewhere")
    text = other_world(tmp_path / "flight.mcap", moved)
    assert text is not None and "is scored in 'elsewhere'" in text and "differ in their goal" in text
    (tmp_path / "flight.csv").write_text("t,x,y,z\n0,0,0,0\n")
    assert other_world(tmp_path / "flight.csv", moved) is None
