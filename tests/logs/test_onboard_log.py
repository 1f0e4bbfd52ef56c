"""The workbench reads the drone's own flight log."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.recordings import RecordingSource, inspect, open_recording
from tests.planner.onboard.simulated import PLACES, SMALL, Relay, Simulation, poles


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a second of flight."""
    path, planner = tmp_path_factory.mktemp("log") / "flight.mcap", Planner(SMALL, seed=1)
    relay = Relay()
    simulation = Simulation(planner, poles(PLACES), (18.0, 0.0, 2.0), observers=[relay])
    relay.observers.append(FlightLog(path, SMALL, OnboardConfig(), clock=lambda: simulation.now))
    simulation.engage()
    simulation.run(1.5)
    simulation.node.close()
    planner.close()
    return path


def test_the_log_plays(flown: Path):
    info = inspect(str(flown))
    assert info.sweeps and info.poses
    source = RecordingSource(open_recording(str(flown)))
    try:
        times = source.info.times
        assert times is not None and len(times) > 50
        source.seek(float(times[-1]))
        observation = source.observe()
        # Points that were logged raw come to lie on the poles again; the recording counts from its first position.
        cloud = observation.points + np.array([0.0, 0.0, 2.0], np.float32)
        axes = np.linalg.norm(cloud[:, None, :2] - np.array(PLACES), axis=2).min(axis=1)
        assert len(cloud) > 1000 and np.abs(axes - 0.25).max() < 0.02
    finally:
        source.close()


WRITER = """
import sys
import numpy as np
from aero_planner import PlannerConfig, VehicleState
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.interfaces import PointPacket, VehicleSample
from aero_planner.onboard.settings import OnboardConfig
import time

log = FlightLog(sys.argv[1], PlannerConfig(), OnboardConfig())
k = 0
while True:
    now = time.monotonic()
    state = VehicleState(np.array([0.01 * k, 0.0, 2.0]), np.array([1.0, 0.0, 0.0]), np.array([1.0, 0, 0, 0]), None, now)
    log.observe(VehicleSample(now, state, True, True, now))
    log.observe(PointPacket(np.ones((500, 3), np.float32) * (1 + k % 7), now - np.linspace(0.02, 0.0, 500)))
    k += 1
    if k % 50 == 0:
        print(k, flush=True)
    time.sleep(0.02)
"""


def test_a_truncated_log_plays(tmp_path: Path):
    path = tmp_path / "cut.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        for _ in range(3):  # three seconds' worth
            assert process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    recording = open_recording(str(path))
    try:
        assert len(recording.sweep_times) >= 10 and recording.poses is not None
        assert any("truncated" in problem for problem in recording.problems)
    finally:
        recording.close()
