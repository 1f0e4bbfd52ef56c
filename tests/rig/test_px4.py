"""The rig's parts for PX4 that can be tested without it: its folder, its process, its true pose and its log."""

import dataclasses
import json
import math
import os
import re
import stat
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.rig.px4_log import summarize_log
from aero_viz.rig.px4_process import Px4Process, find_px4
from aero_viz.rig.px4_truth import TruthTracker
from aero_viz.rig.result import Handover
from tests.rig.results import RESULT

LAG = 0.08  # [s]


def program(folder: Path, text: str) -> Path:
    """Write a script where PX4's binary would be."""
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    path = folder / "bin" / "px4"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_a_folder_without_px4_is_an_error(tmp_path):
    with pytest.raises(UserError, match=r"There is no build/px4_sitl_default/bin/px4 in .*make px4_sitl_default"):
        find_px4(tmp_path)
    with pytest.raises(UserError, match="is not a folder"):
        find_px4(tmp_path / "missing")


def test_px4_is_found_from_its_sources_and_from_its_build(tmp_path):
    build = tmp_path / "build" / "px4_sitl_default"
    path = program(build, "exit 0")
    assert find_px4(tmp_path) == find_px4(build) == path.resolve()
    path.chmod(0o644)
    with pytest.raises(UserError):
        find_px4(tmp_path)


def test_a_program_that_ends_is_reported_with_its_last_line(tmp_path):
    program(tmp_path, "echo starting; echo; echo no can do; exit 3")
    process = Px4Process(tmp_path)
    try:
        while len(process.log()) < 2:
            pass
        errors = []
        while len(errors) < 2:
            try:
                process.check()
            except UserError as error:
                errors.append(str(error))
    finally:
        process.close()
    assert errors[0] == errors[1]
    match = re.fullmatch(r"PX4 has ended with exit code 3: no can do \(all that it wrote: (.*)\)", errors[0])
    # The lines above the last one often have the reason. They outlive the process, in one copy.
    assert match is not None and Path(match[1]).read_text() == "starting\nno can do\n"
    os.remove(match[1])


def test_the_process_is_started_in_its_own_folder_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("PX4_HOME_LAT", "1")
    program(tmp_path, 'mkdir -p log/a; : > log/a/1.ulg; env | grep -c ^PX4_; echo "$@"; pwd; exec sleep 60')
    process = Px4Process(tmp_path)
    while len(process.log()) < 3:
        process.check()
    variables, arguments, folder = process.log()
    # Only the model is set: PX4's own variables in the user's shell would change the flight.
    assert variables == "1"
    assert arguments == f"-d -i {process.system - 1} -w {folder} {tmp_path.resolve() / 'etc'}"
    process.pause()
    assert process.stop() == Path(folder, "log/a/1.ulg")
    process.close()
    assert not os.path.exists(folder)


def truth(*, north=0.0, east=0.0, up=0.0, velocity=(0.0, 0.0, 0.0), q=(1.0, 0.0, 0.0, 0.0)):
    """Return a HIL_STATE_QUATERNION at a place [m] with a velocity, north-east-down [m/s]."""
    metre = math.degrees(1.0 / 6_371_000.0)
    vx, vy, vz = (round(100.0 * v) for v in velocity)
    lon = 8.5 + metre * east / math.cos(math.radians(47.4))
    return SimpleNamespace(
        lat=round(1e7 * (47.4 + metre * north)), lon=round(1e7 * lon), alt=round(1e3 * (488.0 + up)),
        vx=vx, vy=vy, vz=vz, attitude_quaternion=q,
    )  # fmt: skip


def test_the_true_pose_is_placed_in_the_world_and_interpolated():
    tracker = TruthTracker(np.array([10.0, -5.0, 0.5]), heading=math.pi / 2)  # PX4's north is the world's y
    tracker.add_time(SimpleNamespace(time_boot_ms=900))
    assert tracker.home is None
    turned = (math.cos(0.1), 0.0, 0.0, math.sin(0.1))  # by 0.2 rad to the right
    for stamp, state in (
        (1000, truth()),
        (1004, truth(north=3.0, east=2.0, up=1.5, velocity=(4.0, 0.0, -1.0), q=turned)),
    ):
        tracker.add_state(state)
        tracker.add_time(SimpleNamespace(time_boot_ms=stamp))
    assert tracker.time == tracker.newest.time == pytest.approx(1.004)
    np.testing.assert_allclose(tracker.newest.position, [12.0, -2.0, 2.0], atol=0.02)
    np.testing.assert_allclose(tracker.newest.velocity, [0.0, 4.0, 1.0], atol=1e-9)
    half = tracker.at(1.002)
    np.testing.assert_allclose(half.position, [11.0, -3.5, 1.25], atol=0.02)
    yaw = math.pi / 2 - 0.1
    np.testing.assert_allclose(half.quaternion, [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], atol=1e-6)
    # The estimator began one metre too far north and half a metre too high.
    origin = (47.4 + math.degrees(1.0 / 6_371_000.0), 8.5, 488.5)
    np.testing.assert_allclose(tracker.local(np.array([10.0, 15.0, 2.5]), origin), [19.0, 0.0, 1.5], atol=0.02)
    np.testing.assert_allclose(tracker.local(np.array([10.0, 15.0, 2.5]), None), [20.0, 0.0, 2.0], atol=0.02)


def write_log(path: Path, topics: dict[str, tuple[str, np.ndarray]]) -> Path:
    """Write a ULog. Each topic has its fields, of type float or one uint8_t, and rows of time [s] and values."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message(b"B", bytes(40))
    for name, (fields, _) in topics.items():
        data += message(b"F", f"{name}:uint64_t timestamp;{fields}".encode())
    for number, name in enumerate(topics):
        data += message(b"A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, values) in enumerate(topics.values()):
        for row in values:
            content = struct.pack("<B", int(row[1])) if "uint8_t" in fields else row[1:].astype("<f4").tobytes()
            data += message(b"D", struct.pack("<HQ", number, round(1e6 * row[0])) + content)
    path.write_bytes(data)
    return path


@pytest.fixture
def flight() -> dict[str, tuple[str, np.ndarray]]:
    """The topics of a flight of 10 s, in OFFBOARD from 2 s to 8 s."""
    t = np.arange(0.0, 10.0, 0.01)
    n, zero = len(t), np.zeros_like(t)
    nav = np.where((t >= 2.0) & (t < 8.0), 14, 4)
    wanted = np.sign(np.sin(2.0 * np.pi * t))
    rate = np.zeros(n)
    for k in range(n - 1):
        rate[k + 1] = wanted[k] + math.exp(-0.01 / LAG) * (rate[k] - wanted[k])
    place = "float x;float y;float z;float vx;float vy;float vz;"
    tilt = 0.5 * 0.05
    motors = np.full((n, 4), 0.5)
    motors[300:360, 2] = 1.0
    return {
        "vehicle_status": ("uint8_t nav_state;", np.stack([t, nav], axis=1)),
        "vehicle_local_position_groundtruth": (place, np.stack([t, 3 * t, zero, zero, zero + 3, zero, zero], axis=1)),
        # Wrong by 1 m at once, which does not count, and by 0.1 m/s.
        "vehicle_local_position": (place, np.stack([t, 3.1 * t + 1, zero, zero, zero + 3.1, zero, zero], axis=1)),
        "vehicle_attitude_groundtruth": ("float[4] q;", np.stack([t, zero + 1, zero, zero, zero], axis=1)),
        "vehicle_attitude": ("float[4] q;", np.stack([t, zero + math.cos(tilt), zero + math.sin(tilt), zero, zero], 1)),
        "vehicle_rates_setpoint": ("float roll;float pitch;float yaw;", np.stack([t, wanted, zero, zero], axis=1)),
        "vehicle_angular_velocity": ("float[3] xyz;", np.stack([t, rate, zero, zero], axis=1)),
        "actuator_motors": ("float[4] control;", np.concatenate([t[:, None], motors], axis=1)),
        "hover_thrust_estimate": ("float hover_thrust;", np.stack([t, zero + 0.47], axis=1)),
    }


def test_a_log_is_summarized(tmp_path, flight):
    log = summarize_log(write_log(tmp_path / "1.ulg", flight))
    assert log is not None
    assert log.offboard_time == pytest.approx(6.0, abs=0.02)
    assert log.position_error == pytest.approx(0.6, abs=0.02)
    assert log.velocity_error == pytest.approx(0.1, abs=1e-3)
    assert log.tilt_error == pytest.approx(0.05, abs=1e-3)
    assert log.rate_lags[0] == pytest.approx(LAG, rel=0.1)
    assert math.isnan(log.rate_lags[1])
    assert log.sign_changes == pytest.approx((2.0, 0.0, 0.0), abs=0.2)
    assert log.saturated == pytest.approx(0.1, abs=0.01)
    assert log.hover_thrust == pytest.approx(0.47)


def test_the_hand_back_is_that_of_the_log(tmp_path, flight):
    """The heartbeats tell of it 0.9 s late, when PX4 has already braked."""
    fields, values = flight["vehicle_local_position_groundtruth"]
    values[:, 4] = np.clip(3.0 - 2.5 * (values[:, 0] - 8.0), 0.0, 3.0)
    _, tilts = flight["vehicle_attitude_groundtruth"]
    half = 0.1 * np.clip(1.0 - (tilts[:, 0] - 8.0), 0.0, 1.0)
    tilts[:, 1], tilts[:, 2] = np.cos(half), np.sin(half)
    log = summarize_log(write_log(tmp_path / "1.ulg", flight))
    seen = dataclasses.replace(RESULT, handover=Handover(6.9, 0.75, 0.02)).with_log(log)
    assert seen.px4_log is log and seen.handover is not None
    assert seen.handover.time == pytest.approx(6.0, abs=0.02)
    assert seen.handover.speed == pytest.approx(3.0, abs=0.03)
    assert seen.handover.tilt == pytest.approx(0.2, abs=0.01)
    # In a flight that the node ends, OFFBOARD lasts until the log's end.
    assert dataclasses.replace(RESULT).with_log(log).handover is None
    assert fields and dataclasses.replace(RESULT, handover=seen.handover).with_log(None).handover is seen.handover


def test_the_hover_thrust_is_that_of_the_flight(tmp_path, flight):
    fields, values = flight["hover_thrust_estimate"]
    flight["hover_thrust_estimate"] = fields, np.where((values[:, :1] > 8.5) & [False, True], np.nan, values)
    log = summarize_log(write_log(tmp_path / "1.ulg", flight))
    assert log is not None
    assert log.hover_thrust == pytest.approx(0.47)


def test_a_summary_with_unknown_values_is_json(tmp_path, flight):
    del flight["hover_thrust_estimate"]
    log = summarize_log(write_log(tmp_path / "1.ulg", flight))
    assert log is not None
    content = json.loads(json.dumps(log.to_dict(), allow_nan=False))
    assert content["hover_thrust"] is None
    assert content["rate_lags"][0] == pytest.approx(LAG, rel=0.1)
    assert content["rate_lags"][1:] == [None, None]


def test_a_log_that_ends_as_offboard_begins_has_no_summary(tmp_path):
    status = ("uint8_t nav_state;", np.array([[1.0, 4.0], [2.0, 14.0]]))
    assert summarize_log(write_log(tmp_path / "1.ulg", {"vehicle_status": status})) is None


def test_a_program_for_another_computer_is_an_error(tmp_path):
    program(tmp_path, "").write_bytes(b"\x7fELF and nothing else")
    with pytest.raises(UserError, match=r"cannot be started .*build PX4 on this computer"):
        Px4Process(tmp_path)


def test_a_log_without_offboard_or_without_content(tmp_path, flight):
    fields, values = flight["vehicle_status"]
    values = values.copy()
    values[:, 1] = 4
    assert summarize_log(write_log(tmp_path / "1.ulg", {"vehicle_status": (fields, values)})) is None
    (tmp_path / "2.ulg").write_bytes(b"no log at all")
    with pytest.raises(UserError, match="cannot be read"):
        summarize_log(tmp_path / "2.ulg")
