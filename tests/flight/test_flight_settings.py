import json

import pytest

from aero_viz.flight import FlightRules, StateNoise, VehicleModel
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.sensors import lidar_model


@pytest.mark.parametrize("noise", [None, StateNoise(position=0.05)])
def test_settings_return_from_a_log(noise: StateNoise | None):
    settings = FlightSettings(
        seed=3,
        lidar=lidar_model("spinning64+d435@180"),
        drone=VehicleModel(drag=0.3),
        noise=noise,
        rules=FlightRules(ticks_per_plan=5),
    )
    assert FlightSettings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


def test_absent_settings_have_their_defaults():
    assert FlightSettings.from_dict({}) == FlightSettings()


def test_values_out_of_bounds_are_refused():
    with pytest.raises(ValueError, match="mass"):
        FlightSettings.from_dict({"drone": {"mass": -1.0}})
