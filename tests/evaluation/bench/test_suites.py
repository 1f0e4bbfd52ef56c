import pytest

from aero_planner import PlannerConfig
from aero_viz.evaluation.bench import BENCHMARKS
from aero_viz.evaluation.bench.published_results import PUBLISHED
from aero_viz.scenes import scene
from aero_viz.sensors import lidar_model


@pytest.mark.parametrize("benchmark", BENCHMARKS.values(), ids=BENCHMARKS)
def test_rows_can_be_flown(benchmark):
    assert len({row.label for row in benchmark.rows}) == len(benchmark.rows)
    for row in benchmark.rows:
        base = PlannerConfig() if row.preset is None else PlannerConfig.preset(row.preset)
        config = base.replace({**row.changes, "vehicle.speed_limit": row.speed})
        assert config.vehicle.speed_limit == row.speed
        assert lidar_model(row.lidar).points_per_sweep > 0
        assert (row.x is None) == (benchmark.x_label == "")


@pytest.mark.parametrize("name", ["rooms", "density"])
def test_worlds_are_named_as_their_rows_say(name):
    for row in BENCHMARKS[name].rows[:4]:
        assert scene(row.scene, count=row.count, seed=7).name.startswith(f"{row.world_kind}-")


def test_every_ablation_changes_the_first_row():
    first, *variants = BENCHMARKS["ablation"].rows
    assert first.preset is None and first.changes == {"costs.use_ground": True}
    configured = PlannerConfig().replace(first.changes)
    same = {"K = 256", "N = 25"}  # the default values
    for row in variants:
        base = PlannerConfig() if row.preset is None else PlannerConfig.preset(row.preset)
        assert (base.replace(row.changes) == configured) == (row.label in same)


def test_acceptance_targets_are_for_the_full_sphere_on_fresh_seeds():
    benchmark = BENCHMARKS["default"]
    targets = {row.world_kind: row.target for row in benchmark.rows if row.target}
    assert targets == {
        "forest-100": (0.98, 5.6),
        "verticals-300": (0.95, None),
        "inclines-400": (0.98, None),
        "inclines-800": (0.85, 5.0),
    }
    assert all(row.lidar == "full-sphere" for row in benchmark.rows if row.target)
    assert benchmark.first_seed >= 1000


def test_published_table_is_whole():
    planners = {row.planner for row in PUBLISHED}
    assert len(planners) == 5 and len(PUBLISHED) == 15
    speeds = {row.scene: row.mean_speed for row in PUBLISHED if row.planner == "AERO-MPPI (paper)"}
    assert speeds == {"forest": 5.60, "verticals": 3.52, "inclines": 5.08}
    for row in PUBLISHED:
        assert row.mean_speed < row.max_speed and row.length_m > 45.0 and row.min_clearance < row.mean_clearance
