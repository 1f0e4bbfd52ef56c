"""`aero-viz inspect`."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import run_json


def test_inspect_describes_real_recordings(capsys: pytest.CaptureFixture[str], shared_datasets: Path) -> None:
    info = run_json(capsys, "inspect", str(shared_datasets / "hilti_os0_A_mcap"))
    assert info["sweeps"] == 24
    assert info["duration_s"] == pytest.approx(11.5, abs=0.1)
    assert {topic["type"] for topic in info["topics"]} == {"nav_msgs/msg/Odometry", "sensor_msgs/msg/PointCloud2"}
