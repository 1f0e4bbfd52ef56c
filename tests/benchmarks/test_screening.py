"""Effects of parameters, from many configurations at once."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.screening import draw_designs, fit_effects, main

CHANGES = [[("costs.q_track", "2"), ("costs.q_track", "9")], [("costs.q_position", "5")], [("way_out.radius", "3")]]
FLAT = [change for own in CHANGES for change in own]


def test_designs_change_half_of_the_parameters_after_the_default():
    designs = draw_designs(CHANGES, 400, seed=0)
    assert designs[0] == {} and len(designs) == 400
    assert {value for design in designs for path, value in design.items() if path == "costs.q_track"} == {"2", "9"}
    assert np.mean([len(design) for design in designs]) == pytest.approx(1.5, abs=0.15)


def test_the_effects_are_those_of_a_linear_model():
    designs = draw_designs(CHANGES, 300, seed=1)
    actual = dict(zip(FLAT, (-0.3, 0.2, 0.4, 0.0), strict=True))
    noise = np.random.default_rng(0).normal(scale=0.1, size=300)
    outcomes = [4.0 + sum(actual[change] for change in design.items()) for design in designs] + noise
    effects = fit_effects(designs, FLAT, outcomes)
    for change, effect in effects.items():
        assert abs(effect.value - actual[change]) < 3.5 * effect.error
        assert 0.1 / np.sqrt(300) < effect.error < 0.03


def test_too_few_configurations_are_refused():
    with pytest.raises(ValueError, match="4 configurations are too few for 4 changes; give more --configurations"):
        fit_effects(draw_designs(CHANGES, 4, seed=0), FLAT, [0.0] * 4)


def test_flights_give_records_and_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    passable, output = tmp_path / "passable.json", tmp_path / "out.jsonl"
    passable.write_text("{}")
    flights = [
        "--rows",
        "random_clutter",
        "--seeds",
        "0",
        "--modes",
        "real",
        "--configurations",
        "6",
        "--processes",
        "1",
    ]
    change = ["--change", "vehicle.speed_limit", "3", "--passable", str(passable), "--output", str(output)]
    assert main([*flights, *change, "--seed", "1"]) == 0
    title, *header, effect = capsys.readouterr().out.splitlines()
    assert title.startswith("real, 7 m/s, 6 configurations, default: ") and len(header) == 2
    assert effect.startswith("| `vehicle.speed_limit` 3 | -"), "a lower limit is slower"
    records = [json.loads(line) for line in output.read_text().splitlines()]
    assert len(records) == 6 and {str(record["changes"]) for record in records} == {
        "{}", "{'vehicle.speed_limit': '3'}"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "message"),
    [(["costs.q_trak", "3"], r"did you mean 'costs\.q_track'"), (["costs.q_track"], "and one value or more")],
)
def test_a_mistake_is_reported_before_the_first_flight(words: list[str], message: str):
    with pytest.raises(ValueError, match=message):
        main(["--change", *words])
